"""Measures the bridge and compares it with other nodes, see cli.py."""
