"""~stop at the links: what it answers, and what is refused while it holds."""
import pytest

from steps import Bus, Steps
from bus_moves import gimbal, lift
from serial_communication.boards.arduino import wire as arduino
from links import ArduinoLink
from serial_communication.boards.arduino.session import CarOptions
from serial_communication.boards.bus import wire as bus
from board_rows import functions
from serial_communication.framing.layout import Value, message_class
from serial_communication.link.session import WARN, Refused
from serial_communication.link.outcome import NOT_SENT

Drive = message_class('Drive', 40, '<hh', [Value('linear.x'), Value('angular.z')])
Horn = message_class('Horn', 41, '<B', [Value('data')])
ZERO, HALT_KEYS = Drive(0, 0), {'cmd2': 0x30, 'srv_type': 'std_srvs/Trigger', 'repeatable': True,
                                'interrupts': True}
STOPPED = 'stopped: call ~stop with data: false'


def stop(steps):
    """What ~stop does with one link."""
    steps.link.session.is_stopped = True
    return steps.link.stop_motion()


def condition(link):
    """The level and the word for programs in /diagnostics."""
    report = link.report(0.0)
    return report.level, dict(report.values)['condition']


@pytest.fixture
def car(logger):
    steps = Steps(ArduinoLink, CarOptions(speed_timeout=0.0), logger=logger)
    steps.link.session.add_motion(ZERO)
    return steps


def test_zeros_are_sent_and_what_moves_is_refused_until_it_is_released(car):
    link = car.run(2.0).link
    link.command(Drive(300, 20))
    link.set_speed(400)
    car.port.wrote.clear()
    assert stop(car) == ''
    zeros = arduino.encode(arduino.SpeedCommand(0)), arduino.encode(ZERO)
    assert set(zeros) <= {each.lstrip(b'\0') for each in car.port.wrote}
    car.run(0.5)
    assert all(car.port.wrote.count(zero) >= 4 for zero in zeros), 'the line may lose one'
    for command in (lambda: link.set_speed(1), lambda: link.command(Drive(0, 1)),
                    lambda: link.command(Horn(0)),
                    lambda: link.command(arduino.ImuCalibration())):
        with pytest.raises(Refused, match=STOPPED) as refused:
            command()
        assert refused.value.cause == 'stopped'
    link.set_steering(1500)
    link.set_led('brake')
    link.set_speed(0)
    link.command(ZERO)
    assert condition(link) == (WARN, 'stopped')
    link.session.is_stopped = False
    link.command(Drive(5, 5))
    assert car.port.wrote[-1] == arduino.encode(Drive(5, 5))


def test_a_stop_of_a_closed_port_fails_holds_and_stops_the_board_that_comes(car):
    car.port.is_there = False
    assert 'closed' in stop(car.run(1.0)) and condition(car.link)[1] == 'stopped'
    car.plug()
    assert car.port.wrote[0].lstrip(b"\0") == arduino.encode(arduino.SpeedCommand(0))
    assert arduino.encode(ZERO) in car.port.wrote
    with pytest.raises(Refused):
        car.link.command(Drive(1, 1))


def test_the_bus_refuses_all_that_is_not_repeatable(logger):
    board = Bus(logger=logger).run(1.0)
    assert stop(board) == ''
    for request in lift(0, 10), gimbal(0, 10), bus.Request(bus.FUNCTION, 0x33):
        outcome = board.call(request)
        assert outcome.status == NOT_SENT and outcome.message == f'{STOPPED}; nothing was sent'
    assert board.call(bus.ENVIRONMENT_REQUEST, bus.ENVIRONMENT_FUNCTION).success
    assert board.call(bus.ECHO_FUNCTION.make_request((b'mine',)), bus.ECHO_FUNCTION).success
    assert condition(board.link) == (WARN, 'stopped') and board.moves == []


def test_a_move_that_cannot_be_interrupted_is_told_and_one_that_waits_is_not_sent(logger):
    board = Bus(logger=logger).run(1.0)
    board.rule = lambda request: b'' if request == lift(0, 100) else None
    first = board.link.submit(lift(0, 100))
    board.run(0.5)
    second = board.link.submit(gimbal(1, 45))
    assert stop(board.run(0.1)) == '"lift up 100 mm" is under way'
    board.give(bus.encode_reply(bus.Reply(bus.OK)), 1.0)
    assert first.outcome.success and second.outcome.status == NOT_SENT
    assert board.moves == [lift(0, 100)]


def test_functions_that_interrupt_are_called_at_once(logger):
    board = Bus(logger=logger).run(1.0)
    halt, = functions({'halt': HALT_KEYS})
    request = halt.make_request(())
    board.link.session.stops.append((request, halt))
    board.rule = lambda request: b'' if request == lift(1, 100) else None
    move = board.link.submit(lift(1, 100))
    board.run(0.5)
    assert stop(board) == ''
    assert board.moves[0] == lift(1, 100) and set(board.moves[1:]) == {request}
    assert not move.outcome.success
