"""Life cycle of a scene: creation, status, sleep, replays, exports, reconstruction restart and deletion."""
