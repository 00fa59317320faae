"""For every test: the package from this checkout, and how long hypothesis searches.

SERIAL_COMMUNICATION_FUZZ_EXAMPLES=10000 makes each property try so many random examples;
without it they are few, and the same in every run.
"""
import importlib.util
import os
import sys

import pytest
from hypothesis import HealthCheck, settings

pytest.register_assert_rewrite('protocol_cases', 'boards', 'fake_boards')

sys.path.insert(0, os.path.join(os.path.dirname(os.path.abspath(__file__)), 'helpers'))
if importlib.util.find_spec('serial_communication') is None:
    sys.path.insert(0, os.path.dirname(os.path.dirname(os.path.abspath(__file__))))

_EXAMPLES = os.environ.get('SERIAL_COMMUNICATION_FUZZ_EXAMPLES', '')

settings.register_profile('quick', max_examples=60, derandomize=True)
settings.register_profile('fuzz', max_examples=int(_EXAMPLES or 60), print_blob=True)
for _name in ('quick', 'fuzz'):
    settings.register_profile(
        _name, settings.get_profile(_name), deadline=None, database=None,
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large,
                               HealthCheck.filter_too_much])
settings.load_profile('fuzz' if _EXAMPLES else 'quick')
