"""The service: scenes in worker processes, frames in over HTTP, views, tracks and parts out."""
