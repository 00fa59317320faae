"""The lift and the gimbal: switches, wires, steps, requests and stops during a motion."""

import os
import re
import subprocess

import pytest

from board_ends import (DOWN, ENVIRONMENT, GIMBAL, LIFT, OK, UP, error, master_end, request,
                        takes)
from waiting import again_if_stalled

STOP = 0x2F
FAILED = error(0x8002)
LEFT, RIGHT, TILT_UP = 0, 1, 2


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


def test_a_spike_on_the_wire_of_an_end_switch_does_not_stop_the_lift(bus):
    board = bus.board
    start_lift(bus, UP, 60)
    for spike in range(1, 6):
        board.wait_until(lambda: board.get('lift_position') > 300 + 8 * spike, 2)
        board.set('lift_switch_spike', 0.0004)
    assert bus.reply(seconds=3) == OK
    assert board.get('lift_position') == 360
    board.set('lift_switch_spike', 0.0004)
    assert bus.function(LIFT, bytes([UP, 1])) == OK
    board.set('lift_switch_spike', 0.1)    # not a spike any more
    assert bus.function(LIFT, bytes([UP, 1])) == FAILED
    assert board.get('lift_position') == 361


def start_again(bus, how):
    bus.board.ask(how)
    bus.board.wait_until(lambda: sync_answered(bus), 3)


def test_gimbal_keeps_its_limit_over_a_reset(bus):
    assert bus.function(GIMBAL, bytes([LEFT, 50])) == OK
    for reset in 'dtr', 'reset':
        start_again(bus, reset)
        assert bus.function(GIMBAL, bytes([LEFT, 121])) == FAILED
        assert bus.board.get('pan_position') == 50
    assert bus.function(GIMBAL, bytes([LEFT, 120])) == OK
    assert bus.board.get('pan_position') == 170


def address_of(image, name):
    """The data address of a variable."""
    table = subprocess.check_output(['avr-nm', image], universal_newlines=True)
    return int(re.search(r'^(\w+) b \w*%s$' % name, table, re.M).group(1), 16) - 0x800000


def test_gimbal_reset_while_its_count_is_stored_knows_where_it_stands(bus, firmware_build):
    """The count has several bytes, which are written one after another: the high ones of the 16
    bits at 153.6 degrees."""
    board = bus.board
    address = address_of(os.path.join(firmware_build, 'ctrl_board.elf'), 'pan_count')
    assert bus.function(GIMBAL, bytes([LEFT, 160])) == OK
    for byte in range(8):
        begun = board.get('pan_position')
        bus.write(request(0x55, GIMBAL, bytes([RIGHT, 20])))
        board.wait_until(lambda: board.get('pan_position') < begun - 2, 2)
        start_again(bus, 'reset_on_change %d' % (address + byte))
        assert begun - 20 < board.get('pan_position') < begun - 2
        left = 170 - board.get('pan_position')    # degrees
        uncounted = 0.1 * (byte + 1)              # at most one step in each reset
        assert bus.function(GIMBAL, bytes([LEFT, int(left) + 2])) == FAILED
        assert bus.function(GIMBAL, bytes([LEFT, int(left - uncounted)])) == OK
        assert bus.function(GIMBAL, bytes([RIGHT, 10])) == OK


def test_gimbal_begins_at_0_when_power_comes(bus):
    assert bus.function(GIMBAL, bytes([TILT_UP, 90])) == OK
    start_again(bus, 'power_cycle')
    assert bus.function(GIMBAL, bytes([TILT_UP, 90])) == OK
    assert bus.function(GIMBAL, bytes([TILT_UP, 1])) == FAILED


def sync_answered(bus):
    """Whether SYNC is answered; what a reset cut off is dropped."""
    bus.forget()
    bus.write(request(0))
    start = bus.board.time
    bus.board.wait_until(lambda: bus.board.time > start + 0.05, 1)
    return bus.forget().endswith(bytes.fromhex('a50000a5'))


def test_slow_lift_goes_as_slow_as_asked(firmware_build):
    with master_end(firmware_build, image='ctrl_board_slow.elf') as master:
        master.sync()
        assert takes(master.board, lambda: master.function(LIFT, bytes([UP, 5])), 125 / 120.0)
        assert master.board.get('lift_top_rate') == pytest.approx(120, rel=0.02)


def test_no_step_is_lost_within_the_torque_curve(bus):
    board = bus.board
    assert bus.function(LIFT, bytes([UP, 100])) == OK
    assert bus.function(GIMBAL, bytes([LEFT, 60])) == OK
    assert board.get('lift_lost_steps') == board.get('pan_lost_steps') == 0
    assert board.get('lift_top_rate') == pytest.approx(2000, rel=0.1)
    board.set('lift_pull_out', 1500)    # a weaker motor: the emulator would tell
    assert bus.function(LIFT, bytes([DOWN, 100])) == OK
    assert board.get('lift_lost_steps') > 0


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


def test_stop_without_a_move_is_answered(bus):
    assert bus.function(STOP) == OK
    assert bus.function(STOP, b'\x01') == error(0x8001)
    assert bus.function(LIFT, bytes([UP, 1])) == OK


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


@pytest.mark.parametrize('noise', [b'\xa5', b'\xa5\x80\x55', b'\x5a\xff\x00', b'\x00' * 80])
def test_stop_after_noise_is_received(bus, noise):
    board = bus.board
    start_lift(bus)
    bus.write(noise + request(0x55, STOP))
    received_at = board.time
    assert bus.reply(seconds=1) == FAILED
    assert board.get('lift_last_step') < received_at + 0.15
    assert bus.reply() == OK


FALSE_START = b'\x5a\x2c\x01'    # of a frame with 300 bytes of DATE


def answered_among_slow_bytes(bus, data):
    """Sends `data` behind a false start, and a byte every 10 ms; returns the first reply, and how
    many seconds it took."""
    board, sent = bus.board, []

    def first_reply():
        if board.time >= start + 0.01 * len(sent):
            sent.append(b'\x00')
            bus.write(data if len(sent) == 3 else sent[-1])
        return bus.has_reply()

    start = board.time
    bus.write(FALSE_START)
    board.wait_until(first_reply, 6)
    took = board.time - start
    return bus.reply(), took


def test_stop_behind_a_false_start_is_received_though_the_line_is_never_silent(bus):
    def stops_soon():       # if this test stalls, the line is silent
        begun = bus.board.get('lift_position')
        start_lift(bus, DOWN if begun > 300 else UP)
        reply, took = answered_among_slow_bytes(bus, request(0x55, STOP))
        assert bus.reply() == OK
        moved = abs(bus.board.get('lift_position') - begun)
        return reply == FAILED and took < 0.25 and moved < 50
    again_if_stalled(stops_soon)


def test_request_behind_a_false_start_is_answered_though_the_line_is_never_silent(bus):
    def is_answered_soon():
        reply, took = answered_among_slow_bytes(bus, request(1, 0, b'here'))
        assert reply == b'\x01here'
        return took < 0.25
    again_if_stalled(is_answered_soon)


def test_stop_right_after_the_end_switch_does_not_make_the_move_ok(bus):
    """The board's program is delayed, so it sees both at once. Meanwhile each interrupt of the
    steps lets it do one instruction: with these distances it is past asking for the result."""
    board = bus.board

    def stands():
        last_step, now = board.at_once('lift_last_step', 'time')
        return last_step < now - 0.004

    for distance in 0.7, 0.8, 0.9, 1.0, 1.1:    # mm to the end switch
        begun = board.get('lift_position')
        start_lift(bus)
        board.wait_until(lambda: board.get('lift_position') > begun + 5, 2)
        board.ask('stall 0.08')
        board.set('lift_top', board.get('lift_position') + distance)
        board.wait_until(stands, 1)
        stopped = board.get('lift_position')
        bus.write(request(0x55, STOP))
        assert bus.reply(seconds=1) == FAILED
        assert bus.reply() == OK
        assert board.get('lift_position') == stopped
        board.set('lift_top', 600)


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


@pytest.mark.parametrize('error_percent', [-2, 2])
def test_baud_rate_off_by_2_percent(bus, error_percent):
    bus.board.set('baud_error', error_percent)
    data = bytes(range(256))[:254]
    assert bus.ask(1, 0, data) == b'\x01' + data
    assert bus.function(ENVIRONMENT)[:1] in (OK, b'\x03')


def test_wrong_baud_rate_moves_nothing(firmware_build):
    with master_end(firmware_build) as master:
        master.sync()
        board = master.board
        for percent in (-60, -12, 12, 100):
            board.set('baud_error', percent)
            for _ in range(20):
                master.write(lift(UP, 50) + request(0x55, GIMBAL, bytes([LEFT, 9])))
            start = board.time
            board.wait_until(lambda: board.time > start + 0.3, 1)
        assert board.get('lift_steps') == board.get('pan_steps') == 0
