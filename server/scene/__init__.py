"""The life of a scene: how its parts are put together, its status, replays, exports, sleep, a new beginning."""
