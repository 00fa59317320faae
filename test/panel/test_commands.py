"""The commands of the pages, without a browser and without ROS; the clock is the test's."""
import threading
from types import SimpleNamespace

import pytest
from std_srvs.srv import SetBoolResponse

from waiting import until
from serial_communication.tools.panel import commands as panel_commands
from serial_communication.tools.panel.commands import Commands
from serial_communication.tools.panel.driving import SILENCE, CommandRefused
from serial_communication.tools.panel.news import News
from serial_communication.tools.watch.calls import Answer, Verdict
from serial_communication.tools.watch.topics import boards_of

NODE = '/serial_communication'
PAGE = 'a page'
TWIST = {'type': 41, 'direction': 'to_board', 'ros_type': 'geometry_msgs/Twist', 'layout': '<ff',
         'fields': ['linear.x', 'angular.z'], 'maximum': [1, 2]}


class Outlet:
    """Keeps what is published; refuses while the bridge does not subscribe."""

    def __init__(self):
        self.published, self.subscribed = [], True

    def want(self, classes):
        self.wanted = classes

    def publish(self, messages):
        if not self.subscribed:
            raise CommandRefused('the bridge does not subscribe')
        self.published += messages.items()

    def values(self, name):
        return [getattr(message, 'value', None) if name == '~speed' else message.linear.x
                for other, message in self.published if other == name]


class Panel:
    """Commands with an outlet and a clock; `answer` is what each call is answered."""

    def __init__(self, monkeypatch):
        self.now, self.called, self.may_answer = 100.0, [], threading.Event()
        self.answer = Answer(Verdict.DONE, 'stopped', SetBoolResponse(True, 'stopped'))
        self.news, self.outlet = News(), Outlet()
        bridge = SimpleNamespace(node=NODE, boards=boards_of({}), subscribed={},
                                 parameters={'arduino': {'messages': {'cmd_vel': TWIST}}})
        self.commands = Commands(bridge, self.outlet, self.news,
                                 lambda call, *given: call(*given), lambda: self.now)
        monkeypatch.setattr(panel_commands, 'call', self._call)
        self.tick()

    def _call(self, name, _service_class, request, deadline):
        self.called.append((name, request, deadline))
        self.may_answer.wait(60)
        return self.answer

    def tick(self, seconds=0.0):
        self.now += seconds
        self.commands.tick(self.now, True)

    def drive(self, hold=1, **values):
        self.commands.drive(PAGE, hold, self.now, values or {'~cmd_vel': {
            'linear.x': 0.5, 'angular.z': 0.1}})

    def entry(self, key):
        """The answer to a command, as the pages are told it."""
        return next((each for each in self.news.since(0).get('calls', {}).values()
                     if each['key'] == key), {})

    def wait_for_outcome(self, key):
        self.may_answer.set()
        until(lambda: 'outcome' in self.entry(key), 'it is answered')
        return self.entry(key)['outcome']


@pytest.fixture
def panel(monkeypatch):
    panel = Panel(monkeypatch)
    yield panel
    panel.may_answer.set()


def test_the_base_is_driven_until_the_page_is_silent(panel):
    panel.drive()
    panel.tick(SILENCE * 0.9)
    assert panel.outlet.values('~cmd_vel') == [0.5]
    assert panel.news.since(0)['state']['drives']
    panel.tick(SILENCE * 0.1)
    assert panel.outlet.values('~cmd_vel') == [0.5, 0]
    panel.tick()
    assert not panel.news.since(0)['state']['drives']


def test_the_car_stops_by_its_speed_alone(panel):
    panel.drive(**{'~speed': {'value': 200}, '~steering': {'value': 1900}})
    panel.commands.switch.release(PAGE, 1)
    assert panel.outlet.values('~speed') == [200, 0]
    assert len(panel.outlet.published) == 3


@pytest.mark.parametrize('values', [
    {'~cmd_vel': {'linear.x': 1.5, 'angular.z': 0}}, {'~cmd_vel': {'linear.x': 0.5}},
    {'~lift': {'direction': 0, 'distance': 5}}, {'~nothing': {}}, {'~speed': {'value': 1001}}])
def test_what_is_no_motion_or_out_of_range_does_not_drive(panel, values):
    with pytest.raises(CommandRefused):
        panel.drive(**values)
    assert not panel.outlet.published and not panel.commands.switch.hold


def test_a_hold_ends_even_if_nothing_could_be_published(panel):
    panel.outlet.subscribed = False
    with pytest.raises(CommandRefused, match='does not subscribe'):
        panel.drive()
    panel.outlet.subscribed = True
    panel.tick(SILENCE)
    assert panel.outlet.values('~cmd_vel') == [0]


def test_stop_ends_a_hold_and_calls_the_bridge_at_once(panel):
    panel.drive()
    panel.commands.stop('1')
    assert panel.outlet.values('~cmd_vel') == [0.5, 0]
    until(lambda: panel.called, 'it is called')
    (name, request, deadline), = panel.called
    assert (name, request.data, deadline) == (NODE + '/stop', True, float('inf'))
    assert panel.wait_for_outcome('1') == 'done'
    panel.tick(1)
    assert panel.outlet.values('~speed') == []


def test_a_stop_that_is_not_confirmed_in_half_a_second_publishes_all_zeros(panel):
    panel.commands.stop('1')
    panel.tick(0.49)
    assert not panel.outlet.published
    panel.tick(0.01)
    assert panel.outlet.values('~speed') == panel.outlet.values('~cmd_vel') == [0]


def test_a_stop_that_is_refused_publishes_all_zeros_at_once(panel):
    panel.answer = Answer(Verdict.FAILED, 'the lift is under way')
    panel.commands.stop('1')
    panel.wait_for_outcome('1')
    panel.tick()
    assert panel.outlet.values('~speed') == panel.outlet.values('~cmd_vel') == [0]


@pytest.mark.parametrize('age', [2.1, -0.1, float('inf')])
def test_an_old_command_is_refused_but_stop_never(panel, age):
    for command in (lambda: panel.commands.send('2', panel.now - age, '~bus/sync', {}),
                    lambda: panel.commands.go('3', panel.now - age)):
        with pytest.raises(CommandRefused, match='s old'):
            command()
    panel.commands.stop('1')
    until(lambda: [name for name, *_ in panel.called] == [NODE + '/stop'], 'it is called')


def test_a_message_is_published_and_a_call_is_answered_with_its_reply(panel):
    panel.commands.send('1', panel.now, '~led', {'data': 'left'})
    assert panel.outlet.published[-1][1].data == 'left' and panel.entry('1')['outcome'] == 'sent'
    panel.commands.send('2', panel.now, '~lift', {'direction': 0, 'distance': 7})
    assert panel.entry('2') and 'outcome' not in panel.entry('2')
    assert panel.wait_for_outcome('2') == 'done'
    with pytest.raises(CommandRefused, match='not a command'):
        panel.commands.send('3', panel.now, '/rosout/get_loggers', {})


def test_pages_are_told_the_newest_of_what_has_changed():
    news = News()
    news.tell('samples', 'a', 1)
    first = news.number
    news.tell('samples', 'b', 2)
    news.tell('samples', 'a', 1)
    assert news.since(first) == {'samples': {'b': 2}}
    news.tell('samples', 'a', 3)
    for line in range(5):
        news.add('log', line, 2)
    assert news.since(first) == {'samples': {'a': 3, 'b': 2},
                                 'log': {news.number - 1: 3, news.number: 4}}
    assert news.since(news.number) == {} and news.since(0, ['log', 'samples']) == {}
