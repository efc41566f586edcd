"""The compact 4D file: its size, its errors and its speed."""
