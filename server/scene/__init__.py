"""Life cycle of scenes: creation, status, sleep, replays, exports, restart of the reconstruction, and deletion."""
