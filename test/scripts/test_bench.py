"""The parts of the bench that measure nothing: figures, matching, tables, the other decoders."""
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.bus import wire as bus
from bench import decoders, report
from bench.figures import Bridges, Cpu, Heartbeat, Latency, Load, Spread
from bench.boards import COUNTED, arduino_turn, mcu_turn

PROTOCOLS = decoders.protocols()


# -- figures ----------------------------------------------------------------------------------

def test_percentile():
    values = [5, 1, 4, 2, 3]
    assert [report.percentile(values, percent) for percent in (0, 20, 50, 99, 100)] == [
        1, 1, 3, 5, 5]
    assert math.isnan(report.percentile([], 50))


@given(st.lists(st.integers(), min_size=1), st.floats(0.1, 100))
def test_percentile_is_exceeded_by_no_more_than_the_rest(values, percent):
    found = report.percentile(values, percent)
    assert found in values
    assert sum(value <= found for value in values) >= len(values) * percent / 100 - 1e-9


def test_over_turns():
    figures = report.over_turns([[1, 2, 3], [2, 3, 4], [], [3, 4, 50]], scale=1)
    assert (figures.p50, figures.p99, figures.max, figures.count) == (3, 4, 50, 9)
    assert figures.p999 == 50
    assert math.isnan(report.over_turns([]).p50)


def test_match_finds_the_latest_that_fits():
    sent = [(254, 0.0), (255, 1.0), (256, 2.0), (510, 3.0)]
    latencies, missing = report.match(sent, [(254, 0.25), (0, 2.5), (254, 3.125)], 256)
    assert latencies == [0.25, 0.5, 0.125]
    assert missing == 1


def test_match_ignores_what_was_never_sent():
    assert report.match([(1, 5.0)], [(1, 4.0), (2, 6.0)], 256) == ([], 1)


def test_queue_gaps():
    # (number, first byte of the request, last byte of the reply, bytes)
    exchanges = [(0, 1.0, 2.0, 15), (1, 2.25, 3.0, 15), (2, 9.0, 9.5, 15)]
    calls = [(0.5, 2.1, 0), (0.75, 3.1, 1), (8.9, 9.6, 2)]
    assert report.queue_gaps(exchanges, calls, 0.001) == ([0.25], [6.0])
    # A call that has only just begun may not be in the queue yet.
    assert report.queue_gaps(exchanges[:2], [(0.5, 2.1, 0), (1.9, 3.1, 1)], 0.5) == (
        [], [0.25])


# -- the decoders that it compares with -------------------------------------------------------

@pytest.mark.parametrize('size', (0, 1, 7, decoders.READ))
@pytest.mark.parametrize('link', sorted(PROTOCOLS))
def test_both_decoders_give_the_same_messages(link, size):
    protocol = PROTOCOLS[link]
    reads = decoders.read_in(protocol.clean, size)
    ours = decoders.messages(protocol.package(), reads)
    theirs = decoders.messages(protocol.bytewise(), reads)
    assert ours == theirs
    assert [type(message) for message in ours] == [type(message) for message in theirs]
    assert len(ours) == len(protocol.clean)


@pytest.mark.parametrize('link', sorted(PROTOCOLS))
def test_a_false_frame_costs_the_machine_more_than_the_package(link):
    protocol = PROTOCOLS[link]
    reads = decoders.read_in(decoders.noise(protocol.clean), decoders.READ)
    # But for log lines: the machine takes debris for some that the package refuses as unreadable.
    ours, theirs = ([message for message in decoders.messages(decoder, reads)
                     if not isinstance(message, arduino.Log)]
                    for decoder in (protocol.package(), protocol.bytewise()))
    assert 0 < len(theirs) <= len(ours) <= len(protocol.clean)


def test_long_replies_are_the_same():
    frames = [bus.encode_reply(bus.Reply(bus.ECHO, bytes(size % 256 for size in range(length))))
              for length in (0, 1, 254, 255, 300, 1024)]
    assert decoders.messages(decoders.ByteBus(), frames) == decoders.messages(
        bus.ReplyDecoder(), frames)


def test_every_decoder_is_timed():
    rows = decoders.run(0.0)
    assert {row.link for row in rows} == set(PROTOCOLS)
    for row in rows:
        assert row.package.mb_per_s > 0 and row.bytewise.mb_per_s > 0
        if row.stream == 'clean':
            assert row.same_messages
            assert row.at_best > 0
    hostile = [row for row in rows if row.stream not in ('clean', 'noise')]
    assert len(hostile) == 3 * len(PROTOCOLS)


# -- what the boards send ---------------------------------------------------------------------

@pytest.mark.parametrize('n', (0, 1, 255, 256, 8191, 70000))
def test_a_running_number_comes_back(n):
    imu, ticks, angle, voltage = decoders.messages(
        PROTOCOLS['arduino'].package(), [packet for _, packet in arduino_turn(n)])
    assert imu.az == n % COUNTED['~imu']
    assert ticks.value == n % COUNTED['~ticks']
    assert angle.value == n % COUNTED['~steering_angle']
    assert round(voltage.value * 128) == n % COUNTED['~voltage']
    status, = decoders.messages(
        PROTOCOLS['mcu'].package(), [frame for _, frame in mcu_turn(n)])
    assert status.range_1 == n % COUNTED['mcu/status']


# -- goals and tables -------------------------------------------------------------------------

def spread(value):
    return Spread(value, value, value, value, value, 1)


def cpu(node, percent):
    return Cpu(node, percent, 100.0, [percent])


RESULTS = {
    'latency': [Latency('arduino', 'bridge', spread(1.0), 0),
                Latency('arduino', 'reference', spread(10.0), 0),
                Latency('mcu', 'bridge', spread(3.0), 0),
                Latency('mcu', 'reference', spread(10.0), 0)],
    'heartbeat': [Heartbeat('idle', 'bridge', spread(1.0)),
                  Heartbeat('idle', 'reference', spread(4.0)),
                  Heartbeat('busy', 'bridge', spread(20.0)),
                  Heartbeat('busy', 'reference', spread(80.0)),
                  Heartbeat('busy', 'bare timer', spread(10.0))],
    'cpu': [cpu('bridge', 4.0), cpu('no subscriber', 1.0), cpu('floor', 4.0)],
    'bridges': [Bridges(1, 2.0, 2.0, 500.0, [2.0]), Bridges(4, 9.6, 2.4, 2000.0, [9.6]),
                Bridges(10, 20.0, 2.0, 5000.0, [20.0])],
    'scale': [Load('arduino', 1000000, 100.0, 10, 10, 10.0, 100, 0, 10, 10, 10.0, 5.0, 1.0, 40.0,
                   '', {})],
}
FACTS = {'cores': 2, 'processor': 'any', 'kernel': '6', 'python': '3', 'rospy': '1',
         'load before': 0.1, 'real-time priority': True}


def test_the_worst_figure_decides():
    judged = {row.what: row for row in report.judge(RESULTS)}
    p50 = judged['latency p50, against the polling reference']
    assert (p50.measured, p50.met) == (pytest.approx(0.3), False)
    assert p50.details == 'arduino 0.10, mcu 0.30'
    assert judged['latency p99, likewise'].met
    assert judged['CPU with subscribers, against the rospy floor'].met
    assert judged["heartbeat standard deviation, against the reference's"].met
    assert not judged['heartbeat gap, two busy processes, p99.9'].met
    assert judged['1 Mbaud back to back: lost'].met
    assert judged['CPU of each of ten bridges, against one alone'].measured == pytest.approx(1.2)


def test_every_table_is_written():
    text = report.render(FACTS, report.judge(RESULTS), RESULTS)
    assert text.count('\n\n') == 1 + len(RESULTS)
    assert ['4', '9.60', '2.40', '2000', '9.60'] in [line.split() for line in text.split('\n')]


def test_only_the_sections_that_were_run_are_judged():
    assert report.judge({}) == []
    assert len(report.judge({'latency': RESULTS['latency']})) == 2


def test_plain_is_json():
    assert report.plain({'a': [float('nan'), 1.0], 'b': {'c': (float('nan'),)},
                         'd': [cpu('floor', float('nan'))]}) == {
        'a': [None, 1.0], 'b': {'c': [None]},
        'd': [{'node': 'floor', 'percent': None, 'messages_per_s': 100.0, 'turns': [None]}]}


def test_table():
    assert report.table(('name', 'ms', ''), [('a', 1.25, 'x'), ('bcdef', 12345.6, ''),
                                             ('g', None, 'y')]) == (
        'name      ms\n'
        '-----  -----  -\n'
        'a       1.25  x\n'
        'bcdef  12346\n'
        'g          -  y')
    assert report.table(('a', 'b'), []) == 'a  b\n-  -'
