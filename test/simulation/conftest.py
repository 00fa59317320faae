"""The fixture of these tests."""
from simulation_fixtures import cable  # noqa: F401
