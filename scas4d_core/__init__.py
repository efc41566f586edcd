"""The SCas4D method: arrays in, arrays out. No HTTP, no processes; see docs/architecture.md for the data flow."""
