"""What is posed to contestants, as plain arrays, and what their answers are compared with."""
