"""What is thought of an image before the data are seen: quadratic priors, total variation, and their bases."""
