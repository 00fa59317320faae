"""Bytes in and out of a port, for both ends of a line: links and simulated boards."""
