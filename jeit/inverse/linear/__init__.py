"""Linear difference images: a reconstruction matrix, computed once, times a difference of frames."""
