"""`wire`: explain, show and play back a serial line. See cli.py."""
