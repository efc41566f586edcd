"""The life of a scene: creation, status, sleep, replays, exports, a new beginning, deletion."""
