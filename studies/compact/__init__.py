"""Studies of the compact 4D file: size, errors and speed."""
