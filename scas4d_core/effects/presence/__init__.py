"""Effects on what is there: what moves and what stands, what enters and what leaves."""
