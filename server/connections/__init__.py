"""Connection limits that apply before the application sees a request: sizes, deadlines, connections per address."""
