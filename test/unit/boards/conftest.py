"""The fixtures of every test with a link."""
from link_fixtures import lines, logger  # noqa: F401
