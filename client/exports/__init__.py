"""Takes states out of a scene, a folder or a file: the commands `scas4d export` and its like."""
