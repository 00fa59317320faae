"""Runs a command while it borrows a port of the bridge, see cli.py."""
