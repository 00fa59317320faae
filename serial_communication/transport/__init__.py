"""A port and its pace, for both ends of a line: links and simulated boards."""
