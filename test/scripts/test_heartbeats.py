"""The longest gap between heartbeats at a test board excludes delays of the machine."""
import pytest
from heartbeats import longest_gap

ON_TIME = [0.01 * beat for beat in range(100)]


def late(since, until):
    """Heartbeats between these times are read at the end of the interval."""
    return [until if since <= stamp < until else stamp for stamp in ON_TIME]


@pytest.mark.parametrize('stamps, gap', [
    (ON_TIME, 0.01),
    (late(0.305, 0.385), 0.01),                     # one late read in place of eight
    ([0.405 if 0.3 <= stamp < 0.36 else 0.415 if 0.36 <= stamp < 0.415 else stamp
      for stamp in ON_TIME], 0.01),                 # two reads, far apart
    ([stamp for stamp in ON_TIME if not 0.295 < stamp < 0.335], 0.05),      # four are missing
    ([stamp for stamp in late(0.3, 0.4) if not 0.2 < stamp < 0.215], 0.02),
    ([0.0, 0.045, 0.055, 0.065], 0.045),            # the bridge was suspended, and resumes
    ([0.0, 0.045, 0.051, 0.052, 0.053], 0.023),     # the line was blocked: five in 53 ms
])
def test_the_longest_gap_ignores_late_reads(stamps, gap):
    assert longest_gap(stamps, 100.0) == pytest.approx(gap, abs=1e-9)


def test_a_late_read_never_hides_missing_heartbeats():
    """Every interval without heartbeats, with every interval without reads."""
    for missed in range(1, 10):
        for held in range(0, 10):
            stamps = [max(stamp, 0.6 + 0.01 * held) if stamp >= 0.6 else stamp
                      for stamp in ON_TIME if not 0.305 < stamp < 0.305 + 0.01 * missed]
            assert longest_gap(stamps, 100.0) == pytest.approx(0.01 * (1 + missed), abs=1e-9)
