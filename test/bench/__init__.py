"""Measures the bridge beside other programs: see cli.py."""
