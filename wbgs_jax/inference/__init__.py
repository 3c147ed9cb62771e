"""A trained field as a function, over maps, and as a file."""
