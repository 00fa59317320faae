"""The simulated main control board."""
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from simulation_bench import Bench, running, until

from serial_communication.boards.bus.functions import read_functions
from serial_communication.boards.bus.link import BusLink, BusSettings
from serial_communication.link.connection import Connection
from serial_communication.transport.port import Port
from serial_communication.boards.bus import wire as bus
from serial_communication.boards.bus.simulator import MEMORY, PAN_RANGE, TILT_RANGE, ControlBoard
from serial_communication.simulation.faults import Faults, parse

SYNC = bus.encode_request(bus.SYNC_REQUEST)
LIFT_10 = bus.encode_request(bus.lift(0, 10))
STOP = bus.Request(bus.FUNCTION, 0x2F)
STOPS = read_functions({'stop': {'cmd2': 0x2F, 'srv_type': 'std_srvs/Trigger', 'repeatable': True,
                                 'interrupts': True}})


def make(synchronised=True, **arguments):
    bench = Bench(ControlBoard(**arguments),
                  bus.ReplyDecoder(arguments.get('reply_has_cmd2', False)))
    if synchronised:
        bench.feed(SYNC)
        assert bench.messages() == [bus.Reply(bus.SYNC)]
    return bench


def ask(bench, request, seconds=4.0):
    """The replies within `seconds`."""
    bench.feed(request if isinstance(request, bytes) else bus.encode_request(request))
    bench.run(seconds)
    return bench.messages()


def damaged(frame):
    return frame[:-1] + bytes((frame[-1] ^ 1,))


def test_refuses_requests_before_sync():
    bench = make(synchronised=False)
    assert ask(bench, bus.lift(0, 10)) == [bus.Reply(bus.INVALID, b'\x10')]
    assert bench.board.lift.at(bench.now) == 500
    assert ask(bench, bus.SYNC_REQUEST) == [bus.Reply(bus.SYNC)]
    assert ask(bench, bus.lift(0, 10)) == [bus.Reply(bus.OK)]


@pytest.mark.parametrize('size', [0, 4, 254, 255, 1024])
def test_echo(size):
    data = bytes(range(256)) * 4
    assert ask(make(), bus.echo(data[:size])) == [bus.Reply(bus.ECHO, data[:size])]


def test_lift_moves_by_the_requested_distance_at_its_speed():
    bench = make()
    bench.feed(bus.encode_request(bus.lift(1, 200)))
    bench.run(1.0)
    assert bench.board.lift.at(bench.now) == pytest.approx(400)
    assert bench.messages() == []
    bench.run(1.01)
    assert bench.messages() == [bus.Reply(bus.OK)]
    assert bench.board.lift.at(bench.now) == 300
    assert bench.said[-1] == 'lift: down 200 mm: 500 -> 300 mm'


def test_longest_motions_end_within_the_motion_timeout():
    for request in (bus.lift(0, 255), bus.gimbal(0, 170), bus.gimbal(2, 90)):
        assert ask(make(), request, BusSettings().motion_timeout * 0.7) == [bus.Reply(bus.OK)]


def test_lift_refuses_to_leave_its_range():
    bench = make()
    assert [ask(bench, bus.lift(0, 250)) for _ in range(2)] == 2 * [[bus.Reply(bus.OK)]]
    assert ask(bench, bus.lift(0, 1)) == [bus.Reply(bus.ERROR, b'\x02\x80')]
    assert bench.board.lift.at(bench.now) == 1000
    assert ask(bench, bus.lift(1, 255)) == [bus.Reply(bus.OK)]
    assert len(bench.notes.of('executed')) == 4     # SYNC and three moves


@pytest.mark.parametrize('direction, angle, pan, tilt', [
    (0, 30, 30, 0), (1, 30, -30, 0), (2, 90, 0, 90), (3, 90, 0, -90)])
def test_gimbal(direction, angle, pan, tilt):
    bench = make()
    assert ask(bench, bus.gimbal(direction, angle)) == [bus.Reply(bus.OK)]
    assert (bench.board.pan.at(bench.now), bench.board.tilt.at(bench.now)) == (pan, tilt)


@pytest.mark.parametrize('direction, angle', [(0, 171), (1, 171), (2, 91), (3, 91)])
def test_gimbal_limits(direction, angle):
    bench = make()
    assert ask(bench, bus.gimbal(direction, angle)) == [bus.Reply(bus.ERROR, b'\x02\x80')]
    assert (bench.board.pan.at(bench.now), bench.board.tilt.at(bench.now)) == (0, 0)


def test_the_gimbals_limits_are_those_of_the_reference_firmware():
    header = Path(__file__).parents[3].joinpath('firmware/ctrl_board/board.h').read_text('utf-8')
    for name, limits in (('Pan', PAN_RANGE), ('Tilt', TILT_RANGE)):
        limit = int(re.search(r'k%sLimit = (\d+);' % name, header).group(1))
        assert limits == (-limit, limit)


@pytest.mark.parametrize('request_, code', [
    (bus.Request(0x55, 0x20, b'\x02\x10'), 0x8001),
    (bus.Request(0x55, 0x20, b'\x00'), 0x8001),
    (bus.Request(0x55, 0x20, b'\x00\x10\x00'), 0x8001),
    (bus.Request(0x55, 0x21, b'\x04\x10'), 0x8001),
    (bus.Request(0x55, 0x22, b'\x04\x10\x10'), 0x8001),
    (bus.Request(0x55, 0x23), 0x8000),
    (bus.Request(0x02), 0x8000),
    (bus.Request(0xFF), 0x8000)])
def test_refusals(request_, code):
    bench = make()
    reply, = ask(bench, request_)
    assert reply.cmd1 == bus.ERROR and reply.error_code == code
    assert len(bench.notes.of('executed')) == 1     # the SYNC


@pytest.mark.parametrize('datelen', [0, 2])
def test_environment(datelen):
    bench = make()
    replies = ask(bench, bus.encode_request(bus.ENVIRONMENT_REQUEST, datelen))
    first, = [bus.Environment.unpack(reply.data) for reply in replies]
    assert 50 < first.smoke < 250 and 15 < first.temperature < 30 and 30 < first.humidity < 60
    bench.run(60)
    second = bus.Environment.unpack(ask(bench, bus.ENVIRONMENT_REQUEST)[0].data)
    assert second != first


def test_memory_function():
    bench = make()
    assert ask(bench, bus.Request(0x55, MEMORY, b'abc')) == [bus.Reply(bus.OK, b'abc')]
    assert bench.board.memory == b'abc'


def test_replies_with_cmd2_or_data_or_none_to_echo():
    assert ask(make(echoes=False), bus.echo(b'1')) == []
    assert ask(make(ok_data=b'\1\2'), bus.lift(0, 1)) == [bus.Reply(bus.OK, b'\1\2')]
    assert ask(make(reply_has_cmd2=True), bus.lift(0, 1)) == [bus.Reply(bus.OK, b'', 0x20)]


def test_request_that_is_too_long_is_refused():
    bench = make(max_length=300)
    assert ask(bench, bus.echo(bytes(301))) == [bus.Reply(bus.INVALID, b'\x20')]
    assert ask(bench, bus.echo(bytes(300))) == [bus.Reply(bus.ECHO, bytes(300))]


def test_damaged_request_gets_one_invalid_after_a_silence():
    bench = make()
    bench.feed(damaged(LIFT_10))
    bench.run(0.045)
    assert bench.messages() == []
    bench.run(4)
    assert bench.messages() == [bus.Reply(bus.INVALID, b'\x40')]
    assert ask(bench, LIFT_10) == [bus.Reply(bus.OK)]
    assert bench.board.lift.at(bench.now) == 510


@pytest.mark.parametrize('noise', [b'\x00', b'\xa5', b'\xa5\x00\x01', b'\x5a', damaged(LIFT_10),
                                   b'\xa5\x00\x00\x00\x11'])
def test_noise_around_a_request_gets_no_invalid(noise):
    """After an INVALID the Master would send the request again: two moves."""
    for data in (noise + LIFT_10, LIFT_10 + noise, noise + LIFT_10 + noise):
        bench = make()
        assert ask(bench, data) == [bus.Reply(bus.OK)]
        assert bench.board.lift.at(bench.now) == 510
    bench = make()
    bench.feed(noise)
    bench.run(0.03)
    assert ask(bench, LIFT_10) == [bus.Reply(bus.OK)]


@pytest.mark.parametrize('data', [b'\x01\x02\x03', LIFT_10[:-1], LIFT_10[1:], b'\xa5', b'\x5a\xff'])
def test_noise_and_incomplete_requests_get_no_reply(data):
    bench = make()
    assert ask(bench, data) == []
    assert ask(bench, LIFT_10) == [bus.Reply(bus.OK)]


def test_incomplete_request_is_given_up_after_50_ms():
    bench = make()
    bench.feed(LIFT_10[:4])
    bench.run(0.06)
    assert ask(bench, LIFT_10[4:]) == []
    assert bench.board.lift.at(bench.now) == 500


def test_requests_during_a_motion_are_answered_after_it():
    bench = make()
    bench.feed(LIFT_10 + bus.encode_request(bus.echo(b'1')) + bus.encode_request(bus.echo(b'2')))
    assert bench.messages() == []
    bench.run(1)
    assert bench.messages() == [bus.Reply(bus.OK), bus.Reply(bus.ECHO, b'1'),
                                bus.Reply(bus.ECHO, b'2')]


def test_a_function_that_interrupts_ends_the_motion():
    bench = make(custom=STOPS)
    bench.feed(bus.encode_request(bus.lift(0, 100)) + bus.encode_request(bus.gimbal(0, 30)))
    bench.run(0.5)
    bench.feed(bus.encode_request(STOP))
    assert bench.messages() == [bus.Reply(bus.ERROR, b'\2\x80'), bus.Reply(bus.OK)]
    bench.run(3)
    assert bench.messages() == [] and bench.board.pan.at(bench.now) == 0
    assert bench.board.lift.at(bench.now) == pytest.approx(550)


def test_reset_forgets_the_sync_and_leaves_the_lift_where_it_is():
    bench = make()
    bench.feed(bus.encode_request(bus.lift(0, 100)))
    bench.run(0.5)
    bench.board.power_off(bench.now)
    bench.board.power_on(bench.now)
    assert bench.board.lift.at(bench.now + 9) == pytest.approx(550)
    assert ask(bench, LIFT_10) == [bus.Reply(bus.INVALID, b'\x10')]


@given(st.lists(st.tuples(st.binary(max_size=40) | st.sampled_from(
    [SYNC, LIFT_10, damaged(LIFT_10), b'\xa5', b'\x5a\x00\x04']), st.floats(0, 0.2))))
def test_works_after_any_input_and_sends_at_most_one_reply_a_request(chunks):
    bench = make()
    before = len(bench.notes.of('request'))
    for data, pause in chunks:
        bench.feed(data)
        bench.run(pause)
    bench.run(3)
    assert len(bench.notes.of('tx')) - 1 <= len(bench.notes.of('request')) - before
    bench.feed(SYNC)
    assert bench.messages()[-1] == bus.Reply(bus.SYNC)


def test_journal_of_a_request():
    bench = make()
    ask(bench, LIFT_10)
    request, executed = bench.notes.of('request')[-1], bench.notes.of('executed')[-1]
    done, reply = bench.notes.of('done')[-1], bench.notes.of('tx')[-1]
    assert request == {'k': 2, 'raw': LIFT_10.hex(), 'valid': True, 'text': 'lift up 10 mm'}
    assert executed == {'n': 2, 'k': 2, 'raw': LIFT_10.hex(), 'cmd1': 0x55, 'cmd2': 0x20,
                        'data': '000a', 'text': 'lift up 10 mm'}
    assert done['k'] == 2 and done['lift'] == 510
    assert reply['k'] == 2 and reply['ok'] and reply['raw'] == 'a50002a7'


def test_a_request_changed_by_a_fault_is_not_genuine():
    """Insert faults until one turns a request into another valid one, with a valid checksum."""
    bench = Bench(ControlBoard(), bus.ReplyDecoder(),
                  faults=Faults(parse(['rx-insert=1'], ControlBoard), 5))
    bench.board.synchronised = True
    request = bus.encode_request(bus.lift(0, 0xD2))
    for _ in range(4000):
        bench.feed(request)
        bench.run(0.2)
        bench.board.power_off(bench.now)
        bench.board.power_on(bench.now)
        bench.board.synchronised = True
    valid = [fields for fields in bench.notes.of('request') if fields['valid']]
    odd = [fields for fields in valid if fields['raw'] != request.hex()]
    assert valid and odd
    assert all(('genuine' in fields) == (fields['raw'] != request.hex()) for fields in valid)


# -- with the real link over a real tty -------------------------------------------------------

def test_a_link_moves_the_lift_before_and_after_an_unplug(cable, monkeypatch):
    monkeypatch.setattr(Connection, 'may_be_from_a_stall', lambda self: False)
    board = ControlBoard(lift_speed=2000)
    with running(board, cable.far) as notes:
        link = BusLink(Port(cable.near), BusSettings(environment_period=0.05))
        link.start()
        until(lambda: link.master.in_step, 'SYNC')
        assert link.lift(0, 100).success and board.lift.at(1e9) == 600
        cable.unplug()
        until(lambda: not link.port.is_open, 'the loss')
        cable.plug()
        until(lambda: link.port.is_open and link.master.in_step, 'the return')
        assert link.lift(1, 50).success and board.lift.at(1e9) == 550
        link.stop()
        link.join(10.0)
        assert [fields['open'] for fields in notes.of('port')][-3:] == [True, False, True]
    lifts = [fields for fields in notes.of('executed') if fields['cmd2'] == bus.LIFT]
    assert [fields['data'] for fields in lifts] == ['0064', '0132']
