"""Linear difference imaging: a reconstruction matrix that is computed once multiplies a difference of frames."""
