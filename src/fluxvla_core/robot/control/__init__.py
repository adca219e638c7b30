"""What commands an arm: clock, chunks, filters, limits, stops; nothing of policies or pictures."""
