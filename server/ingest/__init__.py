"""Frame ingest: receives, validates, stores, orders and acknowledges frames."""
