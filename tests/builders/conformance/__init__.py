"""Files of other programs, and what is true of them."""
