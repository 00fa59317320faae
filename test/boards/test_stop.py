"""~stop at the links: what is sent at once, and what is refused while it holds."""
import threading

import pytest

from fake_boards import BusBoard, CarBoard, until
from waiting import PATIENCE, Waiter
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.arduino.link import ArduinoLink, ArduinoSettings
from serial_communication.boards.bus import wire as bus
from serial_communication.boards.bus.functions import read_functions
from serial_communication.boards.bus.link import BusLink, BusSettings
from serial_communication.framing.layout import Value, message_class
from serial_communication.link.link import WARN, Refused
from serial_communication.link.outcome import NOT_SENT
from serial_communication.transport.port import Port

Drive = message_class('Drive', 40, '<hh', [Value('linear.x'), Value('angular.z')])
Horn = message_class('Horn', 41, '<B', [Value('data')])
ZERO, HALT_KEYS = Drive(0, 0), {'cmd2': 0x30, 'srv_type': 'std_srvs/Trigger', 'repeatable': True,
                                'interrupts': True}
SETTINGS = BusSettings(reply_timeout=PATIENCE, motion_timeout=PATIENCE, environment_period=0.0)


def stop(link):
    """What ~stop does with one link."""
    link.is_stopped = True
    return link.stop_motion()


def condition(link):
    """The level and the word for programs in /diagnostics."""
    report = link.report(0.0)
    return report.level, dict(report.values)['condition']


@pytest.fixture
def car(line, running):
    return running(CarBoard(line, messages=(Drive, Horn)))


@pytest.fixture
def car_link(line, logger, running):
    link = running(ArduinoLink(Port(line.path), ArduinoSettings(speed_timeout=0.0), logger=logger))
    link.add_motion(ZERO)
    return link


def test_zeros_are_sent_and_what_moves_is_refused_until_it_is_released(car, car_link):
    until(lambda: car_link.heartbeats_sent)
    car_link.command(Drive(300, 20))
    car_link.set_speed(400)
    until(lambda: car.speeds == [400])
    assert stop(car_link) == ''
    for command in (lambda: car_link.set_speed(1), lambda: car_link.command(Drive(0, 1)),
                    lambda: car_link.command(Horn(0)), car_link.calibrate_imu):
        with pytest.raises(Refused) as refused:
            command()
        assert refused.value.cause == 'stopped'
        assert 'stopped: call ~stop with data: false' in str(refused.value)
    car_link.set_steering(1500)
    car_link.set_led('brake')
    car_link.set_speed(0)
    car_link.command(ZERO)
    assert condition(car_link) == (WARN, 'stopped')
    until(lambda: arduino.LedCommand('brake') in car.messages())
    # After the stop nothing moves: every speed and every motion is its zero.
    messages = car.messages()
    after = messages[messages.index(arduino.SpeedCommand(0), messages.index(Drive(300, 20))):]
    assert {each for each in after if isinstance(each, (arduino.SpeedCommand, Drive, Horn))} == {
        arduino.SpeedCommand(0), ZERO}
    car_link.is_stopped = False
    car_link.command(Drive(5, 5))
    until(lambda: Drive(5, 5) in car.messages())


def test_the_zeros_are_repeated_since_the_line_may_lose_one(car, car_link):
    until(lambda: car_link.heartbeats_sent)
    car_link.command(Drive(300, 20))
    car_link.set_speed(400)
    stop(car_link)
    until(lambda: car.messages().count(ZERO) >= 4)
    until(lambda: car.messages().count(arduino.SpeedCommand(0)) >= 4)


def test_an_accepted_command_ends_the_repetition(car, car_link):
    until(lambda: car_link.heartbeats_sent)
    stop(car_link)
    car_link.is_stopped = False
    car_link.command(Drive(300, 20))
    car.wait_for_heartbeats(30)
    messages = car.messages()
    assert ZERO not in messages[messages.index(Drive(300, 20)):]


def test_a_stop_of_a_closed_port_fails_holds_and_stops_the_board_that_comes(
        line, running, logger):
    path = line.path
    line.unplug()
    link = running(ArduinoLink(Port(path), ArduinoSettings(speed_timeout=0.0), logger=logger))
    link.add_motion(ZERO)
    assert 'closed' in stop(link)
    assert condition(link)[1] == 'stopped'
    line.plug()
    board = running(CarBoard(line, messages=(Drive,)))
    until(lambda: ZERO in board.messages())
    first = board.messages()[0]
    assert first == arduino.SpeedCommand(0) and isinstance(first, arduino.SpeedCommand)
    with pytest.raises(Refused):
        link.command(Drive(1, 1))


@pytest.fixture
def control_board(line, running):
    return running(BusBoard(line))


@pytest.fixture
def bus_link(line, logger, running):
    link = running(BusLink(Port(line.path), SETTINGS, logger=logger))
    until(lambda: link.master.synchronised and link.master.in_step)
    return link


def test_the_bus_refuses_all_that_is_not_repeatable(control_board, bus_link):
    assert stop(bus_link) == ''
    for outcome in (bus_link.lift(0, 10), bus_link.gimbal(0, 10),
                    bus_link.request(bus.Request(bus.FUNCTION, 0x33))):
        assert outcome.status == NOT_SENT
        assert outcome.message == 'stopped: call ~stop with data: false; nothing was sent'
    assert bus_link.environment()[0].success
    assert bus_link.call(bus.ECHO_FUNCTION, (b'mine',)).success
    assert condition(bus_link) == (WARN, 'stopped')
    assert control_board.moves() == []


def test_a_move_that_cannot_be_interrupted_is_told_and_one_that_waits_is_not_sent(
        control_board, bus_link):
    goes_on = threading.Event()

    def slow(_request):
        goes_on.wait(PATIENCE)
        return bus.Reply(bus.OK)

    control_board.script.append(slow)
    first = Waiter(bus_link.lift, 0, 100)
    until(lambda: control_board.moves())
    second = Waiter(bus_link.gimbal, 1, 45)
    until(lambda: list(bus_link.master.calls))
    answer = stop(bus_link)
    goes_on.set()
    assert answer == '"lift up 100 mm" is under way'
    assert first.result().success and second.result().status == NOT_SENT
    assert control_board.moves() == [bus.lift(0, 100)]


def test_functions_that_interrupt_are_called_at_once(control_board, bus_link):
    halt, = read_functions({'halt': HALT_KEYS})
    request = halt.make_request(())
    bus_link.stops.append((request, halt))
    control_board.script.append(b'')        # the move is not answered
    move = Waiter(bus_link.lift, 1, 100)
    until(lambda: control_board.moves())
    assert stop(bus_link) == ''
    until(lambda: request in control_board.moves())
    assert not move.result().success
    assert control_board.moves()[0] == bus.lift(1, 100)
    assert set(control_board.moves()[1:]) == {request}
