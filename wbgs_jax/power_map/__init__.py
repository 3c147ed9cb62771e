"""Maps of received power, learned from readings."""
