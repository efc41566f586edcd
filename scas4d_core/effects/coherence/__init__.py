"""Effects that tie what moves together."""
