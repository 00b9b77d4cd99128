"""Commands of `jeit`, one module each: a command parses its options, calls functions of jeit, and prints the
results."""
