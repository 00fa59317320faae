"""The lift and the gimbal: switches, wires, steps, requests and stops during a motion."""


import pytest

from board_ends import (DOWN, GIMBAL, LIFT, OK, UP, error, request)

STOP = 0x2F
FAILED = error(0x8002)
LEFT = 0


def lift(direction, distance):
    return request(0x55, LIFT, bytes([direction, distance]))


def start_lift(bus, direction=UP, distance=200):
    moves = bus.board.get('lift_moves')
    bus.write(lift(direction, distance))
    bus.board.wait_until(lambda: bus.board.get('lift_moves') == moves + 1, 1)


@pytest.mark.parametrize('wire, direction', [('lift_top_wire', UP), ('lift_bottom_wire', DOWN)])
def test_broken_wire_of_an_end_switch_stops_the_lift(bus, wire, direction):
    board = bus.board
    start_lift(bus, direction)
    board.set(wire, 0)
    assert bus.reply(seconds=1) == FAILED
    stopped = board.get('lift_steps')
    assert bus.function(LIFT, bytes([direction, 10])) == FAILED    # refused
    assert board.get('lift_steps') == stopped
    assert bus.function(LIFT, bytes([DOWN if direction == UP else UP, 10])) == OK
    board.set(wire, 1)
    assert bus.function(LIFT, bytes([direction, 10])) == OK
    assert board.get('lift_steps') == stopped


def start_again(bus, how):
    bus.board.ask(how)
    bus.board.wait_until(lambda: sync_answered(bus), 3)


def sync_answered(bus):
    """Whether SYNC is answered; what a reset cut off is dropped."""
    bus.forget()
    bus.write(request(0))
    start = bus.board.time
    bus.board.wait_until(lambda: bus.board.time > start + 0.05, 1)
    return bus.forget().endswith(bytes.fromhex('a50000a5'))


@pytest.mark.parametrize('count', [34, 80])
def test_fences_during_a_move_are_answered_after_it(bus, count):
    """A Master that has lost patience sends ECHO after ECHO, and needs the last one back."""
    start_lift(bus, UP, 60)
    for number in range(count):
        bus.write(request(1, 0, b'n%03d' % number))
    assert bus.reply(seconds=5) == OK
    assert bus.board.get('lift_steps') == 1500
    replies = [bus.reply()]
    while replies[-1] != b'\x01n%03d' % (count - 1):
        replies.append(bus.reply())
    expected = range(count - len(replies), count)
    assert replies == [b'\x01n%03d' % number for number in expected]
    if count <= 34:
        assert len(replies) == count
    bus.silence(0.1)
    assert bus.board.get('lift_moves') == 1


def test_too_many_requests_during_a_move_are_executed_once_or_never(bus):
    board = bus.board
    start_lift(bus, UP, 100)
    for _ in range(100):    # 700 bytes of a buffer's 306
        bus.write(request(0x55, GIMBAL, bytes([LEFT, 1])))
    bus.write(request(1, 0, b'last'))
    replies = [bus.reply(seconds=5)]
    while replies[-1] != b'\x01last':
        replies.append(bus.reply(seconds=2))
    assert set(replies[:-1]) == {OK}
    assert board.get('pan_steps') == 10 * (len(replies) - 2)
    assert board.get('lift_steps') == 2500


def test_stop_ends_the_move_at_once(bus):
    board = bus.board
    start_lift(bus)
    board.wait_until(lambda: board.get('lift_position') > 305, 2)
    bus.write(request(0x55, STOP))
    received_at = board.time
    assert bus.reply(seconds=1) == FAILED    # the lift: carried out in part
    assert bus.reply() == OK                 # the stop
    assert board.get('lift_last_step') < received_at + 0.03
    stopped = board.get('lift_steps')
    bus.silence(0.2)
    assert board.get('lift_steps') == stopped < 5000
    assert bus.function(LIFT, bytes([DOWN, 1])) == OK
    assert board.get('lift_steps') == stopped - 25


def test_stop_takes_the_place_of_the_moves_that_wait(bus):
    board = bus.board
    start_lift(bus)
    bus.write(lift(UP, 200) + request(0x55, GIMBAL, bytes([LEFT, 90])) + request(0x55, STOP))
    bus.write(request(1, 0, b'after'))
    assert bus.reply(seconds=1) == FAILED
    assert bus.reply() == OK
    assert bus.reply() == b'\x01after'
    bus.silence(0.3)
    assert board.get('lift_moves') == 1
    assert board.get('pan_steps') == 0


def test_request_that_waited_behind_noise_is_not_called_invalid(bus):
    """INVALID says that nothing is executed: a Master that reads it sends the request again."""
    board = bus.board
    noise = bytes.fromhex('a500000001')    # a request whose checksum is wrong
    held_up = 0
    for count in range(1, 31):
        sent, received = board.get('tx_bytes'), board.get('rx_bytes')
        bus.write(noise)
        board.wait_until(lambda: board.get('rx_bytes') == received + len(noise), 1)
        stalls_from = board.time
        board.ask('stall 0.05')
        bus.write(request(0x55, GIMBAL, bytes([count % 2, 1])))
        board.wait_until(lambda: board.get('rx_bytes') == received + len(noise) + 7, 1)
        now, sent_now = board.at_once('time', 'tx_bytes')
        replies = [bus.reply(seconds=2)]
        if replies != [OK]:
            replies.append(bus.reply(seconds=2))
        if now < stalls_from + 0.05:        # the board has not read the request yet
            in_time = sent_now == sent      # else INVALID came before the request
            assert replies == ([OK] if in_time else [b'\xff\x40', OK])
            held_up += in_time
        else:
            assert replies in ([OK], [b'\xff\x40', OK])
        if held_up == 3:
            break
    assert held_up
    assert board.get('pan_moves') == count
