"""The simulated main control board."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from simulation_bench import Bench

from board_rows import functions
from bus_moves import gimbal, lift
from serial_communication.boards.bus import wire as bus
from serial_communication.boards.bus.simulator import ControlBoard

SYNC = bus.encode_request(bus.SYNC_REQUEST)
LIFT_10 = bus.encode_request(lift(0, 10))
STOP = bus.Request(bus.FUNCTION, 0x2F)
STOPS = functions({'halt': {'cmd2': 0x2F, 'srv_type': 'std_srvs/Trigger', 'repeatable': True,
                            'interrupts': True}})


def make(**arguments):
    bench = Bench(ControlBoard(**arguments),
                  bus.ReplyDecoder(arguments.get('reply_has_cmd2', False)))
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


@pytest.mark.parametrize('size', [0, 4, 254, 255, 1024])
def test_echo(size):
    data = bytes(range(256)) * 4
    assert ask(make(), bus.echo(data[:size])) == [bus.Reply(bus.ECHO, data[:size])]


def test_lift_moves_by_the_requested_distance_at_its_speed():
    bench = make()
    bench.feed(bus.encode_request(lift(1, 200)))
    bench.run(1.0)
    assert bench.board.lift.at(bench.now) == pytest.approx(400)
    assert bench.messages() == []
    bench.run(1.01)
    assert bench.messages() == [bus.Reply(bus.OK)]
    assert bench.board.lift.at(bench.now) == 300


def test_lift_refuses_to_leave_its_range():
    bench = make()
    assert [ask(bench, lift(0, 250)) for _ in range(2)] == 2 * [[bus.Reply(bus.OK)]]
    assert ask(bench, lift(0, 1)) == [bus.Reply(bus.ERROR, b'\x02\x80')]
    assert bench.board.lift.at(bench.now) == 1000
    assert ask(bench, lift(1, 255)) == [bus.Reply(bus.OK)]


@pytest.mark.parametrize('direction, angle, pan, tilt', [
    (0, 30, 30, 0), (1, 30, -30, 0), (2, 90, 0, 90), (3, 90, 0, -90),
    (0, 171, 0, 0), (1, 171, 0, 0), (2, 91, 0, 0), (3, 91, 0, 0)])
def test_the_gimbal_turns_within_its_limits(direction, angle, pan, tilt):
    bench = make()
    assert ask(bench, gimbal(direction, angle)) == [
        bus.Reply(bus.OK) if pan or tilt else bus.Reply(bus.ERROR, b'\x02\x80')]
    assert (bench.board.pan.at(bench.now), bench.board.tilt.at(bench.now)) == (pan, tilt)


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


@pytest.mark.parametrize('datelen', [0, 2])
def test_environment(datelen):
    bench = make()
    replies = ask(bench, bus.encode_request(bus.ENVIRONMENT_REQUEST, datelen))
    first, = [bus.Environment.unpack(reply.data) for reply in replies]
    assert 50 < first.smoke < 250 and 15 < first.temperature < 30 and 30 < first.humidity < 60
    bench.run(60)
    second = bus.Environment.unpack(ask(bench, bus.ENVIRONMENT_REQUEST)[0].data)
    assert second != first


def test_replies_with_cmd2_or_data_or_none_to_echo():
    assert ask(make(echoes=False), bus.echo(b'1')) == []
    assert ask(make(ok_data=b'\1\2'), lift(0, 1)) == [bus.Reply(bus.OK, b'\1\2')]
    assert ask(make(reply_has_cmd2=True), lift(0, 1)) == [bus.Reply(bus.OK, b'', 0x20)]


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


def test_requests_during_a_motion_are_answered_after_it():
    bench = make()
    bench.feed(LIFT_10 + bus.encode_request(bus.echo(b'1')) + bus.encode_request(bus.echo(b'2')))
    assert bench.messages() == []
    bench.run(1)
    assert bench.messages() == [bus.Reply(bus.OK), bus.Reply(bus.ECHO, b'1'),
                                bus.Reply(bus.ECHO, b'2')]


def test_a_function_that_interrupts_ends_the_motion():
    bench = make(custom=STOPS)
    bench.feed(bus.encode_request(lift(0, 100)) + bus.encode_request(gimbal(0, 30)))
    bench.run(0.5)
    bench.feed(bus.encode_request(STOP))
    assert bench.messages() == [bus.Reply(bus.ERROR, b'\2\x80'), bus.Reply(bus.OK)]
    bench.run(3)
    assert bench.messages() == [] and bench.board.pan.at(bench.now) == 0
    assert bench.board.lift.at(bench.now) == pytest.approx(550)


def test_reset_forgets_the_sync_and_leaves_the_lift_where_it_is():
    bench = make()
    bench.feed(bus.encode_request(lift(0, 100)))
    bench.run(0.5)
    bench.board.power_off(bench.now)
    bench.board.power_on(bench.now)
    assert bench.board.lift.at(bench.now + 9) == pytest.approx(550)
    assert ask(bench, LIFT_10) == [bus.Reply(bus.INVALID, b'\x10')]


@given(st.lists(st.tuples(st.binary(max_size=40) | st.sampled_from(
    [SYNC, LIFT_10, damaged(LIFT_10), b'\xa5', b'\x5a\x00\x04']), st.floats(0, 0.2))))
def test_works_after_any_input_and_sends_at_most_one_reply_a_request(chunks):
    bench, requests = make(), []
    take = bench.board.frame
    bench.board.frame = lambda frame, now: requests.append(frame) or take(frame, now)
    for data, pause in chunks:
        bench.feed(data)
        bench.run(pause)
    bench.run(3)
    assert bench.line.frames - 1 <= len(requests)
    bench.feed(SYNC)
    assert bench.messages()[-1] == bus.Reply(bus.SYNC)
