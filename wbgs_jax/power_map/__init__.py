"""Maps of received power, learned from measured powers (readings)."""
