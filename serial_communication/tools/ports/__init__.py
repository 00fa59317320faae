"""`ports`: which board is on which port. See cli.py."""
