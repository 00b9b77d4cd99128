"""Small dense systems in elementwise operations and matrix products, which batch."""
