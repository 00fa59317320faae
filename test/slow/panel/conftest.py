"""The fixtures of the tests in a browser."""
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / 'panel'))
from panel_fixtures import *  # noqa: E402,F401,F403
