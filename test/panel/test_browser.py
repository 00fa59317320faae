"""The page in a browser: its display, its commands, and outages of bridge, master and panel."""
import contextlib
import os
import re
import shutil
import struct
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import count, starmap

import pytest
import rospy
from boards import PACKAGE, Diagnostics, Topic, again_if_stalled, settle, until
from panel_helpers import GRIPPER, KEPT_BACK, NODE, TOKEN, Network, Panel, free_port, suspended

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Twist, Vector3
from sensor_msgs.msg import Imu, Range
from std_msgs.msg import ColorRGBA, Float32, Float64, Int64, String
from std_srvs.srv import SetBool, SetBoolResponse, Trigger, TriggerResponse

from serial_communication.link.outcome import NOT_SENT, Outcome
from serial_communication.msg import Environment, McuStatus2, SteeringFeedback, Ticks, Voltage
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.bus import wire as bus
from serial_communication.framing.settings import SettingMessage
from serial_communication.srv import Lift, LiftResponse, Release
from serial_communication.tools.watch.topics import TOPICS

if not shutil.which('chromedriver'):
    pytest.skip('no browser: Ubuntu has chromium only as a snap, which no driver can start',
                allow_module_level=True)

from panel_browser import Browser, read_script  # noqa: E402

RIGHT = '\ue014'
UP = '\ue013'


@pytest.fixture(scope='module')
def chromium():
    browser = Browser()
    yield browser
    browser.quit()


@pytest.fixture
def page(chromium, panel):
    """The page of a read-only panel; at the end, its console must have no error."""
    chromium.open(panel.url)
    chromium.wait_for_text('#connection', 'live')
    yield chromium
    assert chromium.errors() == []


@pytest.fixture(scope='module')
def network(control_panel):
    """The network between the browser and the panel that takes commands."""
    network = Network(control_panel)
    yield network
    network.end()


@pytest.fixture
def control_page(chromium, control_panel, network, robot):
    """The page of the panel that takes commands."""
    chromium.open('about:blank')     # or only the part after # changes, and nothing is loaded
    chromium.open(network.url)
    chromium.wait_for_text('#connection', 'live')
    until(lambda: robot.car.connected, 'the car is connected')
    chromium.wait_for_text('[data-link="bus"] .summary', 'ready')
    wait_until_settled(chromium)
    robot.car.forget()
    settle(PACKAGE, robot.bus)
    yield chromium
    chromium.script("document.getElementById('pad')?.blur()")     # no pad: the test failed
    assert chromium.errors() == []


def wait_for_answer(page, words, **options):
    """Wait until an answer begins with these words."""
    page.wait(lambda page: any(each.startswith(words) for each in page.texts('.answers li')),
              f'the answer {words}', **options)


def wait_for_attribute(page, selector, name, value, **options):
    page.wait(lambda page: page.attribute(selector, name) == value, f'{selector} has {value}',
              **options)


def press(page, button, holds, what, click=None):
    """Press an enabled button until `holds(page)`; again if a stall kept the command back.

    Args:
        click: how to press it, called with `button`; by default one click.
    """
    before = page.texts('.answers li')

    def is_kept_back(answers):
        return KEPT_BACK.search(''.join(answers[:1]))

    def press_again():
        # First whether it is enabled: it is not from the click until the page shows an answer.
        if page.all(button + ':enabled'):
            answers = page.texts('.answers li')
            if answers == before or is_kept_back(answers):   # or it was disabled at the click
                (click or page.click)(button)
    page.wait(lambda page: page.all(button + ':enabled'), f'{button} is enabled')
    (click or page.click)(button)
    page.wait(lambda page: holds(page) and not is_kept_back(page.texts('.answers li')), what,
              doing=press_again)


def newest_outcome(page):
    """The outcome of the newest answer."""
    return page.attribute('.answers li', 'data-outcome')


def press_until(page, robot, button, reply, holds, click=None):
    """Press a button of a function, to which the board sends `reply`, until `holds(page)`; again
    if a stall dropped the request or the reply."""
    def tried():
        before = page.texts('.answers li')      # shown until the page is drawn again
        settle(PACKAGE, robot.bus)              # a request may still be on its way
        robot.bus.script.append(reply)
        press(page, button, lambda page: page.texts('.answers li') != before
              and (holds(page) or newest_outcome(page) == 'not known'), 'it is answered', click)
        return holds(page)
    again_if_stalled(tried)


def press_until_done(page, robot, button, reply, click=None):
    """Press a button of a function until it is done."""
    press_until(page, robot, button, reply, lambda page: newest_outcome(page) == 'done', click)


def release_stop(page):
    """Wait until the page shows that STOP holds, and release it there."""
    wait_for_attribute(page, '#stop', 'aria-pressed', 'true')
    press(page, '#release', lambda page: page.attribute('#stop', 'aria-pressed') == 'false',
          'it is released')


def open_dialog(page, form):
    """Press the button of a function until it asks for a confirmation."""
    dialog = form + 'dialog[open]'
    page.wait(lambda page: page.all(dialog), 'the dialog is open',
              doing=lambda: page.all(dialog) or page.click(form + 'button'))


def confirm(page, form):
    """Press the button of a function that asks for a confirmation, and then the one to start."""
    open_dialog(page, form)
    page.click(form + 'dialog button')


def watch_texts(page, place):
    """Return a function that returns the texts that this element has shown since now."""
    page.script("""
        const place = document.querySelector(arguments[0]), texts = [place.textContent];
        (window.texts ??= {})[arguments[0]] = texts;
        new MutationObserver(() => texts.push(place.textContent)).observe(
            place, {childList: true});""", place)
    return lambda: page.script('return window.texts[arguments[0]]', place)


def wait_until_settled(page):
    """Wait until the page takes commands: it has neither appeared nor got the focus just now."""
    page.focus()        # or the first click of the test would do that
    # Until the page is drawn again, the controls look as before.
    page.script("document.getElementById('connection').textContent = 'not drawn yet'")
    page.wait_for_text('#connection', 'live')
    page.wait(lambda page: page.all('[data-service="~lift"] button:enabled'), 'it takes commands')


# -- the display ------------------------------------------------------------------------------


def test_every_reading_shows_the_value_of_its_topic(page, robot):
    robot.imu = arduino.Imu(15000, 3000, -4000, 4000, 100, -200, 300, 1000, -500, 8000, 320)
    robot.bus.air = bus.Environment(417, 31.25, 55.5)
    types = {'~imu': Imu, '~voltage': Voltage, '~ticks': Ticks, '~environment': Environment,
             '~steering_angle': SteeringFeedback, 'mcu/status': McuStatus2}
    table = {topic.name: topic for topic in TOPICS}
    received = {name: Topic(name.replace('~', NODE + '/'), each) for name, each in types.items()}
    page.wait_for_text('[data-reading="~environment:smoke"] .number', '417')
    page.wait(lambda page: set(types) <= {each.split(':')[0] for each in page.readings()},
              'every topic has been received')
    readings = page.readings()
    assert len(readings) >= 18
    seen = set()
    for reading in readings:
        name, field = reading.split(':')
        if name not in received:
            continue
        message = received[name].next(lambda m: getattr(m, 'connected', True))
        value = next(each for each in table[name].values(message) if each.name == field)
        page.wait_for_text(f'[data-reading="{reading}"] .number',
                           f'{value.value:.{value.digits}f}'.replace('-', '\N{MINUS SIGN}'))
        seen.add(name)
    assert seen == set(types)
    for topic in received.values():
        topic.close()


TITLES = {'bus': 'control board', 'arduino': 'model car', 'mcu': 'sensor board'}


def test_link_cards_show_diagnostics(page):
    diagnostics = Diagnostics()
    for name, status in diagnostics.wait_for_all(TITLES, lambda *_: True, 'a status').items():
        card = f'[data-link="{name}"]'
        page.wait_for_text(card + ' .card-head .note', TITLES[name])
        page.wait(lambda page, card=card, port=status.keys['port']: page.text(
            card + ' .port').replace('\n', '') == port, f'{name}: the port')
        page.script("document.querySelector(arguments[0]).open = true", card + ' details')

        def shows_latest(page, name=name, card=card):
            latest = diagnostics.statuses(name)[-1]
            summary, rows = page.script("""
                const card = document.querySelector(arguments[0]);
                return [card.querySelector('.summary').textContent,
                        [...card.querySelectorAll('details tr')].map(
                            tr => [...tr.children].map(cell => cell.textContent))];""", card)
            return summary == latest.message and dict(rows) == latest.keys
        page.wait(shows_latest, f'{name}: summary and all keys of the latest status')

        def age_fits(page, name=name, card=card):
            age = float(diagnostics.statuses(name)[-1].keys['last frame age [s]'])
            shown = page.text(card + ' .facts > div:nth-child(3) dd')
            return shown == ('now' if age < 0.1 else f'{age:.1f} s ago')
        page.wait(age_fits, f'{name}: the last frame is as old as the status has it')


def test_an_error_is_shown_and_counted_by_its_cause(page, robot):
    card = '[data-link="mcu"]'
    wait_for_attribute(page, card, 'data-health', 'ok')
    announced = watch_texts(page, '#announcer')

    def send_wrong():
        robot.sensors.write(b'\x02\x0c\x10\x00' + bytes(10) + b'\x00\x03')    # a wrong CRC

    def three_are_counted():
        before = int(page.text(card + ' .count'))
        for _ in range(3):
            send_wrong()
        page.wait_for_updates(50)       # a status of each second; a stall may drop what was sent
        return int(page.text(card + ' .count')) >= before + 3
    again_if_stalled(three_are_counted)
    # The warning of those three may be over by now on a busy machine.
    wait_for_attribute(page, card, 'data-health', 'warn', doing=send_wrong, every=0.3)
    assert 'checksum' in page.text(card + ' .causes')
    # Or that of the arduino, whose heartbeat is late while this machine is busy.
    page.wait(lambda page: re.match('! (mcu|arduino): warning', page.title), 'the title shows it',
              doing=send_wrong, every=0.3)
    assert any('mcu link: warning' in each for each in announced())
    wait_for_attribute(page, card, 'data-health', 'ok')
    assert 'checksum' in page.text(card + ' .causes')       # also when the warning is over


HOSTILE = '<img src=x onerror=document.title="pwned"><script>document.title="pwned"</script>'


def test_markup_in_a_text_is_shown_as_text(page, robot):
    text = HOSTILE
    page.script("document.getElementById('card-wire').open = true")

    def shows(page):
        return text in page.text('.log') and page.script(
            "return [...document.querySelectorAll('.chip')]"
            ".some(chip => chip.textContent.includes('WARN'))")
    page.wait(shows, 'log and wire show it', doing=lambda: robot.car.say(arduino.Log(2, text)))
    assert 'arduino' in page.texts('.log .link-name')       # it leads to the link's card
    assert page.all('.log img') == page.all('.log script') == page.all('.frame img') == []
    assert 'pwned' not in page.title
    page.script("document.getElementById('card-wire').open = false")


def test_the_wire_shows_filters_pauses_and_explains_frames(page, robot):
    page.click('#card-wire > summary')
    page.wait(lambda page: len(page.all('.frame')) == 16, 'frames are shown')
    for word in ('mcu', 'arduino', 'bus'):
        page.wait(lambda page: word in page.texts('.chip'), word)
    page.script("[...document.querySelectorAll('.chip')]"
                ".find(chip => chip.textContent == 'arduino').click()")
    page.wait(lambda page: {link.split()[0] for link in page.texts('.frame-link')} <= {
        'mcu', 'bus'}, 'the arduino is filtered out')
    page.click('.tools button')       # pause
    shown = page.text('.frames')
    page.wait(lambda page: page.text('.wire .note[role=status]') == 'paused', 'the page shows it')
    page.wait_for_updates(20)
    assert page.text('.frames') == shown
    page.click('.tools button')
    page.wait(lambda page: page.text('.frames') != shown, 'it continues')
    # Pointing at a field highlights its bytes, and the reverse.
    page.script("[...document.querySelectorAll('.chip')]"
                ".filter(chip => !/sensor status|mcu$/.test(chip.firstChild.textContent)"
                " && chip.ariaPressed == 'true').forEach(chip => chip.click())")
    page.wait(lambda page: set(page.texts('.frame-link')) == {'mcu \u2190'},
              'only the sensor board is shown')
    page.script("document.querySelector('.frame:not([data-error])').click()")
    fields = dict(page.script("return [...document.querySelectorAll('.fields > div')].map(field =>"
                              "[field.querySelector('dt').textContent,"
                              " [...field.querySelectorAll('dd')].map(each => each.textContent)])"))
    assert fields['range_1'] == ['470 mm', 'bytes 4 \u2013 5']
    assert fields['CRC'][1] == 'byte 14'
    for pointed_at, highlighted, words in (
            ('.fields > div:nth-child(5)', '.frame-detail .byte[data-lit]', 'd6 01'),    # 470
            ('.frame-detail .byte:nth-child(5)', '.fields [data-lit] dt', 'range_1')):
        page.wait(lambda page: page.texts(highlighted) == [words], f'{words} is highlighted',
                  doing=lambda: page.hover(pointed_at))
    page.click('#card-wire > summary')


_GAUGE = """
from serial_communication.boards.description import Description, Field, Service, Topic

DESCRIPTION = Description(
    'gauge', __name__, lambda sent, parameters: None, 'rain gauge',
    topics=(Topic('~rain', 'std_msgs/Float32', card='Weather'),
            Topic('~sun', 'sensor_msgs/Range', card='Weather'),
            Topic('~breeze', 'geometry_msgs/Vector3')),
    services=(Service('~tilt', 'serial_communication/Lift', 'tilt the funnel', (
                  Field('distance', 'constructor', maximum=30, preset=3),
                  Field('direction', choices=(('\u25b2 out', 0), ('\u25bc in', 1))))),
              Service('~empty', 'std_srvs/Trigger', 'empty', confirm='Its water runs out.'),
              Service('~unknown', 'nowhere/Type', 'unknown')))
"""
PARAMETERS = {
    '~boards': ['wet_gauge', 'not_installed'],
    # A row's name that the bridge itself would refuse.
    '~bus/functions': {'pump': {'cmd2': 48, 'srv_type': 'std_srvs/SetBool'},
                       HOSTILE: {'cmd2': 49, 'srv_type': 'std_srvs/Trigger'}}}
MESSAGES = {
    '~rain': Float32(4.5), '~sun': Range(min_range=0, max_range=2, range=0.5),
    '~breeze': Vector3(1, 2, 3), '~wind': Vector3(1.5, -2.25, 1.25e-9),
    '~colour': ColorRGBA(1, 2, 3, 4), '~motto': String('<b>semper idem</b>'),
    '~big': Int64(2 ** 43), '~bigger': Int64(2 ** 63 - 1), '~huge': Float64(1.7e308),
    '~least': Float64(-1.7e308), '~level': Float64(1e300),
    # Limits that are not finite, as another program may publish them.
    '~odd': Range(min_range=float('nan'), max_range=float('inf'), range=0.25)}


def statuses(number):
    """What the links report; some of it grows with the number."""
    causes = {'constructor': str(number), '__proto__': str(number), 'x' * 5000: '5',
              'square': '\u00b2'}
    values = {'constructor': {**{f'{cause} errors': count for cause, count in causes.items()},
                              'port': 'p' * 5000, 'timeouts': 't' * 5000},
              'bus': {'port': HOSTILE, HOSTILE: HOSTILE, f'{HOSTILE} errors': '3'},
              'gauge': {'port': 'none'}}
    words = {'constructor': 'm' * 5000, 'bus': HOSTILE, 'gauge': 'ready'}
    return [DiagnosticStatus(name=f'odd: {link} link', message=words[link],
                             values=list(starmap(KeyValue, pairs.items())))
            for link, pairs in values.items()]


class SimulatedBridge:
    """A bridge that this process simulates, with custom rows and a board of another package.

    Attributes:
        asked: the calls of its services.
        panel: a panel for it, with commands.
    """

    def __init__(self, folder, stack):
        self.asked = []
        (folder / 'wet_gauge').mkdir()
        (folder / 'wet_gauge' / '__init__.py').write_text(_GAUGE)
        for name, value in PARAMETERS.items():
            rospy.set_param(name, value)
        self._topics = {name: rospy.Publisher(name, type(message), queue_size=1) for name, message
                        in [*MESSAGES.items(), ('/diagnostics', DiagnosticArray())]}
        for topic in self._topics.values():
            stack.callback(topic.unregister)
        for name, kind in ('~pump', SetBool), ('~tilt', Lift), ('~empty', Trigger):
            stack.callback(rospy.Service(name, kind, getattr(self, '_' + name[1:])).shutdown)
        self._numbers = count()
        stack.callback(rospy.Timer(rospy.Duration(0.05), self._publish).shutdown)
        self.panel = stack.enter_context(Panel(
            '--control', '--token', TOKEN, '--node', rospy.get_name(), name='panel_simulated',
            environment={'PYTHONPATH': f'{folder}:{os.environ["PYTHONPATH"]}'}))

    def _publish(self, _event):
        for name, message in MESSAGES.items():
            self._topics[name].publish(message)
        self._topics['/diagnostics'].publish(
            DiagnosticArray(status=statuses(next(self._numbers))))

    def _pump(self, request):
        self.asked.append(request.data)
        return SetBoolResponse(request.data, 'the pump runs' if request.data
                               else Outcome(NOT_SENT, 'it is empty').text)

    def _tilt(self, request):
        self.asked.append((request.direction, request.distance))
        return LiftResponse(success=True)

    def _empty(self, _request):
        self.asked.append('empty')
        return TriggerResponse(True, 'it is dry')


@pytest.fixture(scope='module')
def bridge(core, tmp_path_factory):
    with contextlib.ExitStack() as stack:
        yield SimulatedBridge(tmp_path_factory.mktemp('packages'), stack)


@pytest.fixture
def custom_page(chromium, bridge):
    """The page of a simulated bridge."""
    bridge.asked.clear()
    chromium.open('about:blank')
    chromium.open(bridge.panel.url)
    chromium.wait_for_text('#connection', 'live')
    chromium.focus()
    yield chromium
    assert chromium.errors() == []


def test_custom_topics_appear_and_vanish(custom_page):
    page = custom_page
    card = '[data-custom="~wind"] '
    page.wait_for_text('[data-reading="~wind:y"] .number', '\N{MINUS SIGN}2.25')
    assert page.text('[data-reading="~wind:x"] .number') == '1.5'
    assert page.text('[data-reading="~wind:z"] .number') == '1.25e\N{MINUS SIGN}9'
    assert len(page.all(card + 'canvas')) == 1      # the parts of one vector
    page.wait_for_text('[data-reading="~colour:a"] .number', '4')
    assert len(page.all('[data-custom="~colour"] canvas')) == 4
    page.wait_for_text('[data-reading="~motto:data"] .number', '<b>semper idem</b>')
    assert not page.all('[data-custom="~motto"] canvas')
    page.wait_for_text('[data-reading="~odd:range"] .number', '0.250')
    later = rospy.Publisher('~later', Float32, queue_size=1, latch=True)
    later.publish(7.0)
    page.wait_for_text('[data-reading="~later:data"] .number', '7')
    later.unregister()
    page.wait(lambda page: not page.all('[data-custom="~later"]'), 'the card vanishes')
    # Those of a board of another package: one card for two, a value with limits as a bar.
    weather = '[data-custom="Weather"] '
    page.wait_for_text(weather + '[data-reading="~rain:data"] .number', '4.5')
    page.wait_for_text(weather + '[data-range="~sun:range"] .number', '0.500 m')
    page.wait_for_text('[data-custom="~breeze"] [data-reading="~breeze:y"] .number', '2')


def test_extreme_numbers_and_names_do_no_harm(custom_page):
    page = custom_page
    for name, text in (('big', str(2 ** 43)), ('bigger', str(2 ** 63 - 1)),
                       ('huge', '1.7e+308'), ('least', '\N{MINUS SIGN}1.7e+308')):
        page.wait_for_text(f'[data-reading="~{name}:data"] .number', text)
    page.wait_for_updates(20)       # so that all are drawn
    card = '[data-link="constructor"] '
    for cause in ('constructor', '__proto__'):
        page.wait(lambda page, cause=cause: int(page.text(
            f'{card} [data-cause="{cause}"] b') or 0) > 0, f'{cause} is counted')
    assert 'function' not in page.text(card)
    assert page.script('return document.documentElement.scrollWidth <= innerWidth')
    with phone(page):
        page.wait(lambda page: page.script(
            'return document.documentElement.scrollWidth') == PHONE[0], 'it fits')


def test_a_custom_function_is_offered_and_hostile_names_are_shown_as_text(custom_page, bridge):
    page, form = custom_page, '[data-service="~pump"] '
    page.wait(lambda page: page.all(form + 'button'), 'the function is offered')
    for outcome in ('refused', 'done'):
        press(page, form + 'button',
              lambda page: page.attribute('.answers li', 'data-outcome') == outcome, outcome)
        page.click(form + 'input')
    assert bridge.asked == [False, True]
    answers = page.text('.answers')
    assert 'the pump runs' in answers and 'it is empty' in answers
    for place in '.summary', '.port', 'legend':
        assert any(HOSTILE in each for each in page.script(
            'return [...document.querySelectorAll(arguments[0])].map(e => e.textContent)',
            place)), place
    assert 'pwned' not in page.title
    assert page.all('main img') == page.all('main script') == []


PHONE = (390, 844)


@contextlib.contextmanager
def phone(page):
    """Inside this block, the page is as large as a phone's."""
    page.resize(*PHONE)
    page.wait(lambda page: page.script('return innerWidth') == PHONE[0], 'it is narrow')
    try:
        yield
    finally:
        page.resize(1600, 1000)


def test_on_a_phone_each_part_is_a_tab_and_stop_always_in_sight(control_page, robot):
    page = control_page
    with phone(page):
        tabs = [tab for tab in page.texts('.tabs button') if tab]
        assert tabs == ['Links', 'Drive', 'Commands', 'Car', 'Sensors', 'Wire']
        for tab in tabs:
            shown, width, boxes, pad = page.script("""
                const every = (selector) => [...document.querySelectorAll(selector)];
                every('.tabs button').find((each) => each.textContent === arguments[0]).click();
                scrollTo(0, document.body.scrollHeight);
                const box = (element) => element.getBoundingClientRect();
                return [every('main [data-tab]').filter((each) => each.checkVisibility())
                            .map((each) => each.dataset.tab),
                        document.documentElement.scrollWidth,
                        every('#stop, .tabs button').map(box).map(({top, bottom}) => [top, bottom]),
                        box(document.getElementById('pad')).bottom];""", tab)
            assert set(shown) == {tab} and width == PHONE[0]
            assert all(top >= 0 and bottom <= PHONE[1] for top, bottom in boxes)
            assert tab != 'Drive' or 0 < pad < PHONE[1] - 60
        page.script("document.querySelector('.tabs button').click()")
        # A long name of a port is shortened in its middle.
        port = '[data-link="mcu"] .port'
        page.wait(lambda page: page.script(
            'return document.querySelector(arguments[0]).textContent', port)
            == robot.lines['mcu'].near, 'it is shown')
        begin, end = page.script("""
            const [begin, end] = document.querySelector(arguments[0]).children;
            begin.textContent = '/dev/serial/by-id/usb-Silicon_Labs_CP2102_USB_to_UART_Bridge_';
            return [begin, end].map(e => [e.scrollWidth, e.clientWidth,
                                          e.getBoundingClientRect().right]);""", port)
    assert begin[0] > begin[1] > 0                    # its end has no room
    assert end[0] <= end[1] and end[2] < PHONE[0]     # the end of the name is visible as a whole


# -- commands ---------------------------------------------------------------------------------


def test_a_wrong_amount_moves_nothing_and_a_double_click_moves_once(control_page, robot):
    up, amount = '[data-service="~lift"] button', '[data-service="~lift"] input'
    for value in ('', '0', '256', '2.5', '20'):
        control_page.script('document.querySelector(arguments[0]).value = arguments[1]', amount,
                            value)
        if value != '20':
            control_page.click(up)
            assert control_page.all(amount + ':invalid')
    control_page.wait_for_updates(15)
    assert not robot.lift_requests
    control_page.wait(lambda page: page.all(up + ':enabled'), 'it can be pressed')
    press_until_done(control_page, robot, up, bus.Reply(bus.OK), control_page.double_click)
    control_page.wait(lambda page: page.all(up)[0].is_enabled(), 'the button is enabled again')
    assert [request.data for request in robot.lift_requests] == [bytes((0, 20))]
    assert 'lift up 20 mm done' in control_page.text('.answers li')


def test_the_outcome_is_not_known_if_the_connection_is_lost(control_page, robot, network):
    up = '[data-service="~lift"] button'

    def lost():
        settle(PACKAGE, robot.bus)
        robot.bus.forget()
        robot.bus.script.clear()
        robot.bus.script.append(b'')        # no answer until the timeout, a second later
        control_page.wait(lambda page: page.all(up + ':enabled'), 'it can be pressed')
        control_page.click(up)
        # Without a question to the page, which may take as long.
        with contextlib.suppress(AssertionError):       # a stall kept it back
            until(lambda: robot.lift_requests, 'the request arrives', 10.0)
        with network.cut():
            control_page.wait_for_text('#connection', 'no connection')
        control_page.wait_for_text('#connection', 'live')
        until(lambda: control_page.all('[data-service="~lift"] button')[0].is_enabled(),
              'it is over')
        # Or the machine stalled, and the timeout was over before the connection was lost.
        return 'the connection was lost before the answer was received' in control_page.text(
            '.answers li')
    again_if_stalled(lost)
    control_page.errors()      # the console reports the lost connection, as it should


def test_a_custom_command_is_a_form_with_its_limits(control_page, robot):
    form = '[data-service="~gripper"] '
    assert [each.replace('\n', ' ') for each in control_page.texts(form + 'label')] == [
        'x \N{MINUS SIGN}10 \u2026 10', 'y 0 \u2026 50', 'z 0 \u2026 3']

    def fill(*values):
        control_page.script("document.querySelectorAll(arguments[0] + 'input').forEach("
                            "(input, at) => { input.value = arguments[1][at]; })", form, values)
        control_page.click(form + 'button')
    for values in (('', '', ''), ('-2.5', '50', ''), ('-2.5', '50.1', '3'), ('-2.5', '50', '2.5')):
        fill(*values)
        assert len(control_page.all(form + 'input:invalid')) == max(1, values.count(''))
    control_page.wait_for_updates(15)
    assert GRIPPER not in robot.car.wire

    def send():
        if GRIPPER not in robot.car.wire and control_page.all(form + 'button:enabled'):
            fill('-2.5', '50', '3')
    until(lambda: GRIPPER in robot.car.wire, 'the board receives it', doing=send, every=0.3)
    wait_for_answer(control_page, 'gripper -2.5 50 3 sent')


def test_a_setting_is_a_form_with_a_slider_beside_the_boards_own_value(control_page, robot):
    form = '[data-service="~settings/arduino/kp"] '
    number, slider = form + 'input[type=number]', form + 'input[type=range]'

    def report(value):
        robot.car.write(arduino.encode_raw(253, b'\1' + struct.pack('<f', value)))

    def value_of(selector):
        text = control_page.script(f"return document.querySelector('{selector}').value")
        return float(text or -1)

    def drag(value):
        control_page.script(
            "const [slider, value] = [document.querySelector(arguments[0]), arguments[1]];"
            "slider.value = value; slider.dispatchEvent(new Event('input'));"
            "slider.dispatchEvent(new Event('change'))", slider, value)

    # Again and again: what is on its way when this machine stalls is dropped.
    control_page.wait(lambda page: page.text(form + '.board-value') == '1.5', 'its own value',
                      doing=lambda: report(1.5), every=0.3)
    control_page.wait(lambda page: (value_of(number), value_of(slider)) == (1.5, 1.5), 'both')
    assert 'proportional gain' in control_page.text(form)
    assert '1/s' in control_page.text(form + 'label')
    wanted = 1, tuple(struct.pack('<f', 2.5))
    press(control_page, form + 'button', lambda _page: wanted in [
        tuple(each) for each in robot.car.messages(SettingMessage)], 'the car gets it',
        lambda _button: drag(2.5))
    wait_for_answer(control_page, 'arduino: kp 2.5 done', doing=lambda: report(2.5), every=0.3)
    control_page.wait(lambda page: page.text(form + '.board-value') == '2.5', 'its new value',
                      doing=lambda: report(2.5), every=0.3)
    assert value_of(number) == 2.5


def test_a_page_that_only_looks_says_so_and_how_to_get_commands(page):
    page.wait(lambda page: 'This page only looks' in page.text('#card-commands'), 'it is shown')
    text = page.text('#card-commands')
    assert '--control' in text and 'control:=true' in text and 'tunnel' in text
    assert not any(each.is_displayed() for each in page.all('#stop, #pad, [data-service]'))


def test_calibration_needs_a_confirmation(control_page, robot):
    packet, form = arduino.encode(arduino.ImuCalibration()), '[data-service="~calibrate_imu"] '
    open_dialog(control_page, form)
    control_page.click('#stop')
    release_stop(control_page)       # beside the dialog
    control_page.click(form + 'dialog button:last-of-type')
    assert packet not in robot.car.raw_commands
    robot.sends = False          # as a board that calibrates
    try:
        press(control_page, form + '> .controls button',
              lambda _page: packet in robot.car.raw_commands, 'the board has received it',
              lambda _button: confirm(control_page, form))
        control_page.wait(lambda page: 'calibrating for' in page.text(form + '.words'),
                          'the elapsed time is shown')
    finally:
        robot.sends = True
    control_page.wait(lambda page: page.text(form + '.words') == '', 'the calibration is over')


def test_a_reset_is_asked_for_and_a_lent_link_takes_no_command(control_page, robot):
    reset = '[data-service="~arduino/reset"] '
    open_dialog(control_page, reset)
    assert 'The car stops' in control_page.text(reset + 'dialog')
    control_page.click(reset + 'dialog button:last-of-type')
    assert not any('reset' in each for each in control_page.texts('.answers li'))
    press(control_page, reset + '> .controls button',
          lambda page: 'reset the car refused' in page.text('.answers li'),
          'a pseudo terminal has no line for it', lambda _button: confirm(control_page, reset))
    assert 'has no control lines' in control_page.text('.answers li')
    release = rospy.ServiceProxy(NODE + '/arduino/release', Release)

    def reasons(page):
        return [page.text(f'[data-service="~{link}/reset"] .reason') for link in ('arduino', 'mcu')]
    until(lambda: release('me', 10.0).success, 'it is lent', every=0.3)
    try:
        control_page.wait(lambda page: reasons(page) == ['the arduino link is lent to me', ''],
                          'the reason is beside the commands of this link only')
        assert not control_page.all(reset + 'button')[0].is_enabled()
    finally:
        release('me', 0.0)
    control_page.wait_for_text(reset + '.reason', '')


def test_text_for_the_led_is_sent_and_the_reply_of_a_function_shown_field_by_field(control_page,
                                                                                   robot):
    brake = '[data-service="~led"] button:nth-of-type(3)'

    def show_brake():       # again: a bridge that has stalled drops it, and nothing is answered
        if control_page.all(brake + ':enabled'):
            control_page.click(brake)
    until(lambda: arduino.LedCommand('brake') in robot.car.commands(), 'the board has received it',
          doing=show_brake, every=0.7)
    wait_for_answer(control_page, 'LED brake sent')
    press_until_done(control_page, robot, '[data-service="~weigh"] button',
                     bus.Reply(bus.OK, bytes.fromhex('d204 0000 b841')))
    assert control_page.texts('.answers li:first-child .reply div') == [
        'environment.smoke\n1234', 'environment.temperature\n23', 'environment.humidity\n0']


def test_stop_is_sent_as_soon_as_it_is_pressed_and_once(control_page):
    """A touch that slips or stays, or of a second finger, makes no click."""
    sent = control_page.script("""
        const {send} = WebSocket.prototype, counts = [];
        let count = 0;
        WebSocket.prototype.send = function(text) {
            count += text.includes('"stop"');
            return send.call(this, text);
        };
        for (const part of ['pointerdown', 'click']) {
            document.querySelector('#stop').dispatchEvent(new PointerEvent(part, {button: 0}));
            counts.push(count);
        }
        WebSocket.prototype.send = send;
        return counts;""")
    assert sent == [1, 1]
    release_stop(control_page)


def test_stop_is_sent_also_while_no_update_is_received(control_page, control_panel):
    shown = watch_texts(control_page, '#trouble')
    with suspended(control_panel.process.pid):
        # The page itself looks and clicks, since after 3 s it gives the connection up.
        control_page.script_until_done("""
            const [done] = arguments, timer = setInterval(() => {
              if (document.querySelector('#connection').textContent !== 'no connection') return;
              clearInterval(timer);
              document.querySelector('#stop').click();
              done();
            }, 20);""")
        control_page.wait(lambda page: 'STOP: no answer' in ''.join(shown()), 'it says so')
        assert control_page.attribute('#trouble', 'data-stopped') is None       # it is red
    release_stop(control_page)
    control_page.errors()       # the page may have given up the connection


def test_stop_holds_against_another_program_until_it_is_released(control_page, panel, robot):
    page, sent = control_page, []
    moves, zero = (arduino.encode_raw(41, struct.pack('<ff', speed, 0)) for speed in (0.5, 0))
    topic = rospy.Publisher(NODE + '/cmd_vel', Twist, queue_size=1)

    def drive(_event):
        topic.publish(Twist(linear=Vector3(x=0.5)))
        sent.append(time.monotonic())
    driving = rospy.Timer(rospy.Duration(0.05), drive)
    try:
        until(lambda: moves in robot.car.wire, 'another program drives')
        page.click('#stop')
        wait_for_attribute(page, '#stop', 'aria-pressed', 'true')
        until(lambda: zero in robot.car.wire, 'it is stopped')
        with page.other_tab():      # of a panel that only looks
            page.open(panel.url)
            page.wait_for_text('#trouble', 'stopped until STOP is released')
            assert not page.all('.stops button:not([hidden])')
        since = len(sent)
        until(lambda: len(sent) > since + 40, 'the other program continues')
        wire = bytes(robot.car.wire)
        packets = wire[wire.index(zero):].split(b'\0')
        assert {each + b'\0' for each in packets if each[1:2] == zero[1:2]} == {zero}
        release_stop(page)
        robot.car.forget()
        until(lambda: moves in robot.car.wire, 'it drives again')
    finally:
        driving.shutdown()
        topic.unregister()


# -- the dead man's switch --------------------------------------------------------------------


def hold(page, robot):
    """Press the pad above its middle, and hold it until the car drives.

    If the machine stalls for too long, the hold has to end, and another one begins.
    """
    def press():
        if page.attribute('#pad', 'data-held') is None:
            page.release()
            page.press_at('#pad', 0, -60)

    def drives():
        # The page shows the hold a frame later; a test can only see it end if it was shown.
        return any(speed > 0 for speed in robot.car.speeds) \
            and page.attribute('#pad', 'data-held') is not None
    until(drives, 'the car drives', doing=press, every=0.3)


def has_stopped(robot):
    """The bridge's own SPEED 0, after a stall, is followed by the next command of the pad."""
    return robot.car.speeds[-1] == 0 and robot.car.command_frames[-1].stamp < time.monotonic() - 0.3


def wait_until_stopped(robot, page, what=''):
    until(lambda: has_stopped(robot), f'{what}: the car stops')
    page.wait(lambda page: page.attribute('#pad', 'data-held') is None, f'{what}: the hold ends')
    count = len(robot.car.speeds)
    page.wait_for_updates(15)
    assert not any(robot.car.speeds[count:])


@contextlib.contextmanager
def released(page):
    page.release()
    yield


def scripted(text):
    """A context that begins with this JavaScript."""
    @contextlib.contextmanager
    def begun(page):
        page.script(text)
        yield
    return begun


@contextlib.contextmanager
def stopped(page):
    """Another program calls ~stop, and releases it while the pad is still pressed."""
    stop = rospy.ServiceProxy(NODE + '/stop', SetBool)
    stop(True)
    yield
    page.wait(lambda page: page.text('#pad-words') == 'stopped until STOP is released',
              'the hold ends')
    until(lambda: stop(False).success, 'it is released')


def cut(network):
    """A context in which the connection is lost."""
    @contextlib.contextmanager
    def begun(page):
        with network.cut():
            yield
            page.wait_for_text('#connection', 'no connection')
        page.wait_for_text('#connection', 'live')
    return begun


# Each is a context that ends the hold of the pad, and the reason that the page may show.
ENDS = {
    'the pad is released': (released, 'released'),
    'another control gets the focus': (
        scripted("document.getElementById('speed-limit').focus()"), 'the pad has lost the focus'),
    'the window loses the focus': (
        scripted("window.dispatchEvent(new Event('blur'))"), 'the window has lost the focus'),
    'the tab is hidden': (Browser.other_tab, ''),
    'the page hangs': (
        scripted('const end = performance.now() + 1500; while (performance.now() < end);'), ''),
    'the browser is frozen': (Browser.frozen, ''),
    'another program calls ~stop': (stopped, '')}


def test_whatever_ends_a_hold_stops_the_car(control_page, robot, network):
    for what, (end, words) in {**ENDS, 'the connection is lost': (cut(network), '')}.items():
        def ended():
            robot.car.forget()
            hold(control_page, robot)
            with end(control_page):
                until(lambda: has_stopped(robot), f'{what}: the car stops')
            wait_until_stopped(robot, control_page, what)
            control_page.release()
            return words in control_page.text('#pad-words')     # or it ended before, by a stall
        again_if_stalled(ended)
    control_page.errors()       # it was frozen, and without a connection


def test_a_panel_that_sends_no_updates_stops(control_page, robot, control_panel):
    """Nor does the page show a false reason when the panel continues."""
    troubles = watch_texts(control_page, '#trouble')
    words = watch_texts(control_page, '#pad-words')
    hold(control_page, robot)
    with suspended(control_panel.process.pid):
        control_page.wait(lambda page: page.attribute('#pad', 'data-held') is None, 'the hold ends')
        assert any(each.startswith('stopped: ') for each in words())
        until(lambda: robot.car.speeds[-1] == 0, 'the bridge stops the car')
        control_page.wait(lambda page: re.search(
            r'for ([6-9]\.|\d\d )', page.text('#trouble')), 'it gave up and retries')
    control_page.wait_for_text('#connection', 'live')
    wait_until_stopped(robot, control_page)
    control_page.release()
    shown = ' '.join(troubles())
    assert 'no connection to the panel' in shown
    assert 'pages are open' not in shown and 'token' not in shown
    control_page.errors()    # the connections that it tried


def test_arrow_keys_drive(control_page, robot):
    control_page.script("document.getElementById('pad').focus()")

    def hold_keys(*keys):
        if control_page.attribute('#pad', 'data-held') is None:      # as in `hold`
            control_page.key_up(UP)
            control_page.key_up(RIGHT)
            for key in keys:
                control_page.key_down(key)
    until(lambda: 200 in robot.car.speeds, 'the car drives', doing=lambda: hold_keys(UP),
          every=0.3)
    control_page.key_down(RIGHT)
    until(lambda: arduino.SteeringCommand(1900) in robot.car.commands(), 'it turns',
          doing=lambda: hold_keys(UP, RIGHT), every=0.3)
    control_page.key_up(RIGHT)
    control_page.key_up(UP)
    wait_until_stopped(robot, control_page)


AHEAD, HELD = 'key down ArrowUp', 'key repeat ArrowUp'
DRIVING, RIGHT_AHEAD = 'speed 200, steering 1500', 'speed 200, steering 1900'
RELEASED, OTHER_KEY = 'stopped: released', 'stopped: another key was pressed'
NO_REPEATS = 'stopped: the key no longer repeats; press it again'


def check_pads(page, expected):
    """Check the words that a pad shows after some steps, and whether it drives."""
    found = page.script_until_done(read_script('pads'), list(expected))
    assert dict(zip(expected, found)) == {
        steps: [words, words.startswith('speed'), words.startswith('speed')]
        for steps, words in expected.items()}


def test_which_keys_drive_and_what_else_stops(page):
    """Whether keys and pad reach the car: test_arrow_keys_drive and those before it."""
    check_pads(page, {
        AHEAD: DRIVING, f'{AHEAD}, key down ArrowRight': RIGHT_AHEAD,
        f'{AHEAD}, key down ArrowRight, key up ArrowRight': DRIVING,
        f'{AHEAD}, key up ArrowUp': RELEASED,
        # Keys of the keypad: with NumLock and Shift, one can be pressed as an arrow and released as
        # the digit 8. With a modifier: macOS does not report the release while Cmd is held.
        'key down shift+Numpad8, key up ShiftLeft, key up Numpad8': 'hold to drive',
        'key down meta+ArrowUp': 'hold to drive', 'key down shift+ArrowUp': 'hold to drive',
        # Any other key stops, and one that is still held and repeats does not drive again.
        f'{AHEAD}, key down meta+MetaLeft, {HELD}': OTHER_KEY,
        f'{AHEAD}, key down KeyX, {HELD}': OTHER_KEY,
        f'{AHEAD}, key up Numpad8, {HELD}': RELEASED,
        # Pad and keys do not drive together.
        f'pointer down, {AHEAD}': 'stopped: a key was pressed while the pad was held',
        f'{AHEAD}, pointer down': 'stopped: pressed while a key was held',
        # A key that no longer repeats counts as released; also one that never begins to, on a
        # system that is known to repeat keys.
        f'{AHEAD}, {HELD}, wait 450': DRIVING, f'{AHEAD}, {HELD}, wait 1050': NO_REPEATS,
        f'{AHEAD}, {HELD}, key up ArrowUp, {AHEAD}, wait 2450': DRIVING,
        f'{AHEAD}, {HELD}, key up ArrowUp, {AHEAD}, wait 3050': NO_REPEATS,
        # Systems that repeat no keys, or only the one pressed last, and none after its release.
        f'{AHEAD}, wait 20000': DRIVING,
        f'{AHEAD}, {HELD}, key down ArrowRight, key repeat ArrowRight, key up ArrowRight, '
        'wait 20000': DRIVING})


def test_the_pad_follows_only_the_pointer_that_has_pressed_it(page):
    check_pads(page, {'pointer down 1, pointer move 1 2': RIGHT_AHEAD,
                      'pointer down 1, pointer move 2 2': DRIVING})


# -- outages ----------------------------------------------------------------------------------


def test_the_page_shows_a_restart_of_the_bridge(page, robot):
    wait_for_attribute(page, '[data-link="bus"]', 'data-health', 'ok')
    robot.bridge.end()
    page.wait(lambda page: 'no bridge ' + NODE in page.text('#trouble'), 'the page shows it')
    # A warning if this machine stalled just before.
    assert page.attribute('[data-link="bus"]', 'data-health') in ('none', 'ok', 'warn')
    wait_for_attribute(page, '[data-link="bus"]', 'data-health', 'none')
    robot.start_bridge()
    page.wait(lambda page: page.text('#trouble') == '', 'the trouble is over')
    wait_for_attribute(page, '[data-link="bus"]', 'data-health', 'ok')
    wait_for_attribute(page, '[data-reading="~imu:roll"]', 'data-state', 'fresh')


def test_the_page_shows_a_restart_of_the_master(control_page, robot, core):
    page = control_page
    alarms = watch_texts(page, '#alarm')
    core.stop()
    page.wait(lambda page: 'no answer from the ROS master' in page.text('#trouble'),
              'the page shows it')
    page.wait_for_text('#connection', 'not live')
    page.wait(lambda page: 'no answer from the ROS master' in page.text(
        '[data-service="~lift"] .reason'), 'the reason is shown')
    assert not page.all('[data-service="~lift"] button')[0].is_enabled()
    shown = page.text('#trouble')
    page.wait(lambda page: page.text('#trouble') not in ('', shown), 'its age counts up')
    # A screen reader hears of it once, without the age that changes ten times a second; again
    # after this machine has stalled the panel.
    shown = [each for each in alarms() if each]
    stalls = [each for each in shown if 'no connection to the panel' in each]
    others = [each for each in shown if each not in stalls]
    assert len(others) <= 1 + len(stalls) and len(set(others)) == 1
    assert 'no answer from the ROS master' in others[0]
    core.start()
    page.wait(lambda page: page.text('#trouble') == '', 'the trouble is over')
    page.wait_for_text('#connection', 'live')
    # A new subscription works with the new master, too.
    page.click('#card-wire > summary')
    page.wait(lambda page: page.all('.frame'), 'serial_msg is received')
    page.click('#card-wire > summary')
    page.errors()       # the panel starts again, too, and refuses connections for a moment


def test_the_page_reconnects_after_a_restart_of_the_panel(chromium, robot):
    port = free_port()
    first = Panel(port=port, name='panel_short')
    chromium.open(first.url)
    ticks = '[data-reading="~ticks:ticks"]'
    wait_for_attribute(chromium, ticks, 'data-state', 'fresh')
    first.end()
    chromium.wait(lambda page: 'no connection to the panel' in page.text('#trouble'),
                  'the page shows it')
    wait_for_attribute(chromium, ticks, 'data-state', 'stale')
    second = Panel(port=port, name='panel_short')
    chromium.wait_for_text('#connection', 'live')
    wait_for_attribute(chromium, ticks, 'data-state', 'fresh')
    chromium.open('about:blank')    # or the page tries to connect after the end
    chromium.errors()               # the console reports the refused connections, as it should
    assert second.end() == 0


def serve(content):
    """Another site, with one page."""
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            self.send_header('Content-Type', 'text/html')
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, *_arguments):
            pass

    # Threads: chromium opens a second connection in advance, on which nothing comes for a minute.
    server = ThreadingHTTPServer(('127.0.0.1', 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    return server


def test_a_page_of_another_site_can_neither_connect_nor_embed(chromium, panel):
    evil = f'''<title>evil</title><script>
      const socket = new WebSocket('ws://127.0.0.1:{panel.port}/socket');
      socket.onopen = () => document.title = 'open';
      socket.onerror = () => document.title = 'refused';
    </script><iframe src="http://127.0.0.1:{panel.port}/"></iframe>'''.encode()

    server = serve(evil)
    chromium.open(f'http://localhost:{server.server_port}/')
    chromium.wait(lambda page: page.title == 'refused', 'the connection is refused')
    chromium.driver.switch_to.frame(chromium.all('iframe')[0])
    assert not chromium.all('#node')
    chromium.driver.switch_to.default_content()
    # Nor through a name that resolves to this machine.
    chromium.open(f'http://rebinding.example:{panel.port}/')
    assert 'is not a name of this machine' in chromium.text('body')
    server.shutdown()
    chromium.errors()


def test_the_page_needs_the_token_once(chromium, control_panel, panel):
    chromium.open(control_panel.url.split('#')[0])
    chromium.script('localStorage.clear()')
    chromium.open('about:blank')
    chromium.open(control_panel.url.split('#')[0])
    chromium.wait(lambda page: 'open the address that the panel printed' in page.text(
        '#trouble'), 'the page shows it')
    # A wrong one is told so; the reason stays while the page tries again.
    reasons = watch_texts(chromium, '#trouble')
    chromium.script("location.hash = 'not-the-right-one'")
    chromium.wait(lambda _page: 'its token is wrong' in reasons()[-1], 'the page shows it')
    seen = len(reasons())
    tries = ("return performance.getEntriesByType('resource')"
             ".filter((each) => each.name.endsWith('/key')).length")
    before = chromium.script(tries)
    chromium.wait(lambda page: page.script(tries) > before + 2, 'it tries again')
    assert reasons()[seen - 1:] == ['its token is wrong; '
                                    'open the address that the panel printed']
    chromium.errors()
    chromium.open(control_panel.url)        # in the same tab: only the part after # changes
    chromium.wait_for_text('#connection', 'live')
    assert chromium.script('return location.href') == control_panel.url.split('#')[0]
    history = chromium.driver.execute_cdp_cmd('Page.getNavigationHistory', {})['entries']
    assert not any(TOKEN in entry['url'] for entry in history)
    chromium.open('about:blank')
    chromium.open(control_panel.url.split('#')[0])
    chromium.wait_for_text('#connection', 'live')
    # Nothing of it is sent to another port of this machine.
    assert chromium.driver.get_cookies() == []
    chromium.open(panel.url)
    chromium.wait_for_text('#connection', 'live')
    assert chromium.script('return localStorage.length') == 0
    chromium.errors()
