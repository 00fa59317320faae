"""For every test: the package from this checkout, how long hypothesis searches, what runs together.

SERIAL_COMMUNICATION_FUZZ_EXAMPLES=10000 makes each property try so many random examples;
without it they are few, and the same in every run.
"""
import importlib.util
import os
import sys

import pytest
from hypothesis import HealthCheck, settings

pytest.register_assert_rewrite('protocol_cases', 'boards', 'fake_boards')
_TEST = os.path.dirname(os.path.abspath(__file__))
sys.path.insert(0, os.path.join(_TEST, 'helpers'))
if importlib.util.find_spec('serial_communication') is None:
    sys.path.insert(0, os.path.dirname(_TEST))
import rostests  # noqa: E402  pylint: disable=wrong-import-position
from progress import Progress  # noqa: E402

_EXAMPLES = os.environ.get('SERIAL_COMMUNICATION_FUZZ_EXAMPLES', '')
settings.register_profile(
    'here', max_examples=int(_EXAMPLES or 60), derandomize=not _EXAMPLES, print_blob=True,
    deadline=None, database=None, suppress_health_check=[
        HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.filter_too_much])
settings.load_profile('here')


def pytest_configure(config):
    config.pluginmanager.register(rostests)
    if not hasattr(config, 'workerinput'):      # a worker of pytest-xdist prints nothing
        config.pluginmanager.register(Progress())


@pytest.hookimpl(tryfirst=True)     # before pytest-xdist reads the marks
def pytest_collection_modifyitems(items):
    """What needs one emulated board, or one browser, runs in one worker of pytest-xdist."""
    for item in items:
        for part in {'firmware', 'panel'}.intersection(item.nodeid.split('/')):
            item.add_marker(pytest.mark.xdist_group(part))
