"""The page in a browser: its display, its commands, and outages of bridge, master and panel."""
import contextlib
import os
import re
import shutil
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest
import rospy
from boards import Diagnostics, Topic, again_if_stalled, ranges, until
from panel_helpers import GRIPPER, NODE, TOKEN, Network, Panel, free_port, suspended

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Vector3
from sensor_msgs.msg import Imu, Range
from std_msgs.msg import ColorRGBA, Float32, Float64, Int64, String
from std_srvs.srv import SetBool, SetBoolResponse, Trigger, TriggerResponse

from serial_communication.link.outcome import NOT_SENT, Outcome
from serial_communication.msg import Environment, McuStatus2, SteeringFeedback, Ticks, Voltage
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.bus import wire as bus
from serial_communication.boards.mcu import wire as mcu
from serial_communication.srv import Lift, LiftResponse
from serial_communication.tools.watch.topics import TOPICS

if not shutil.which('chromedriver') and os.path.isdir('/opt/ros/noetic'):
    pytest.skip('no browser: Ubuntu has chromium only as a snap, which no driver can start',
                allow_module_level=True)

from panel_browser import Browser  # noqa: E402

LEFT, RIGHT = '\ue012', '\ue014'
UP = '\ue013'
ESCAPE = '\ue00c'


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
    network.cut()


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
    robot.bus.forget()
    yield chromium
    chromium.script("document.getElementById('pad').blur()")
    assert chromium.errors() == []


def wait_for_answer(page, words, **options):
    """Wait until an answer begins with these words."""
    page.wait(lambda page: any(each.startswith(words) for each in page.texts('.answers li')),
              f'the answer {words}', **options)


def wait_for_attribute(page, selector, name, value):
    page.wait(lambda page: page.attribute(selector, name) == value, f'{selector} has {value}')


def wait_until_settled(page):
    """Wait until the page takes commands: it has neither appeared nor got the focus just now."""
    page.focus()        # or the first click of the test would do that
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


def test_ranges_are_bars_with_their_limits(page, robot):
    received = Topic('/mcu/range_1', Range)
    message = received.first()
    card = '[data-range="mcu/range_1:range"]'
    page.wait_for_text(card + ' .number', '0.470 m')
    assert page.text(card + ' .limits') == \
        f'{message.min_range:.2f} m\n{message.max_range:.2f} m'
    assert page.attribute(card + ' [role=meter]', 'aria-valuenow') == '0.470'
    width = page.script("return document.querySelector(arguments[0]).style.width", card + ' .fill')
    assert width == f'{(0.47 - message.min_range) / (message.max_range - message.min_range):.1%}'
    for millimetres, words, mark in ((65535, 'no reading', 'none'),
                                     (9000, 'farther than 2.00 m', 'far'),
                                     (5, 'nearer than 0.03 m', 'near')):
        robot.ranges = ranges(millimetres)
        page.wait_for_text(card + ' .number', words)
        assert page.attribute(card, 'data-beyond') == mark
        page.wait_for_text('[data-reading="mcu/status:range 1"] .number',
                           '\u2013' if mark == 'none' else str(millimetres))
    robot.ranges = ranges()
    received.close()


TITLES = {'bus': 'control board', 'arduino': 'model car', 'mcu': 'sensor board'}


def test_link_cards_show_diagnostics(page):
    diagnostics = Diagnostics()
    for name, status in diagnostics.wait_for_all(TITLES, lambda *_: True, 'a status').items():
        card = f'[data-link="{name}"]'
        assert page.text(card + ' .card-head .note') == TITLES[name]
        assert page.text(card + ' .port').replace('\n', '') == status.keys['port']
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


def test_a_heartbeat_gap_is_marked_until_it_is_over_and_dropped_bytes_are_shown(page, robot):
    card = '[data-link="arduino"]'
    marked = card + ' dd[data-too-long]'
    wait_for_attribute(page, card, 'data-health', 'ok')
    with suspended(robot.bridge.process.pid):
        threading.Event().wait(0.5)      # a stall, whose backlog is dropped
    page.wait(lambda page: 'heartbeat gap of' in page.text(card + ' .summary')
              and len(page.all(marked)) == 1, 'the gap is shown and marked')
    page.wait(lambda page: re.search(r'stale\s+[1-9][0-9]* bytes', page.text(card + ' .facts')),
              'the dropped bytes are counted')
    page.wait(lambda page: page.attribute(card, 'data-health') == 'ok' and page.all(marked) == []
              and re.fullmatch(r'[0-9.]+ ms, [0-9.]+ s ago', page.text(card + ' .gap')),
              'it is over, and the card says when it was')
    assert page.script('const gap = document.querySelector(arguments[0]);'
                       'return gap.scrollWidth <= gap.clientWidth', card + ' .gap'), 'it is cut off'


def test_the_read_delay_of_a_board_that_sends_its_time_is_shown(page, robot):
    facts = '[data-link="mcu"] .facts'
    assert 'read delay' not in page.text(facts)
    started = time.monotonic()

    def shown(page):
        robot.sensors.write(mcu.encode(mcu.Time(round((time.monotonic() - started) * 1e6)), 0))
        return re.search(r'read delay\s+[0-9.]+ ms', page.text(facts))
    page.wait(shown, 'the delay')


def test_an_error_is_shown_and_counted_by_its_cause(page, robot):
    card = '[data-link="mcu"]'
    wait_for_attribute(page, card, 'data-health', 'ok')
    before = int(page.text(card + ' .count'))
    page.script("""window.announced = [];
        new MutationObserver(() => announced.push(document.getElementById('announcer').textContent))
            .observe(document.getElementById('announcer'), {childList: true});""")
    for _ in range(3):
        robot.sensors.write(b'\x02\x0c\x10\x00' + bytes(10) + b'\x00\x03')    # a wrong CRC
    wait_for_attribute(page, card, 'data-health', 'warn')
    page.wait(lambda page: int(page.text(card + ' .count')) >= before + 3, 'three are counted')
    assert 'checksum' in page.text(card + ' .causes')
    # Or that of the arduino, whose heartbeat is late while this machine is busy.
    page.wait(lambda page: re.match('! (mcu|arduino): warning', page.title), 'the title shows it')
    assert any('mcu link: warning' in each for each in page.script('return announced'))


def test_a_stale_value_shows_its_age(page, robot):
    robot.others = robot.others[1:]         # no VOLTAGE; everything else is still sent
    try:
        reading = '[data-reading="~voltage:voltage"]'
        wait_for_attribute(page, reading, 'data-state', 'stale')
        assert page.text(reading + ' .age').endswith(' old')
        assert page.attribute('[data-reading="~ticks:ticks"]', 'data-state') == 'fresh'
    finally:
        robot.others = [arduino.Voltage(7.4)] + robot.others
    wait_for_attribute(page, reading, 'data-state', 'fresh')
    assert page.text(reading + ' .age') == ''


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


def test_the_wire_shows_filters_and_pauses_frames(page, robot):
    page.click('#card-wire > summary')
    page.wait(lambda page: len(page.all('.frame')) == 16, 'frames are shown')
    for word in ('mcu', 'arduino'):
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
    page.click('#card-wire > summary')


def test_pointing_at_a_field_highlights_its_bytes_and_the_reverse(page, robot):
    page.click('#card-wire > summary')
    page.wait(lambda page: page.all('.frame'), 'frames are shown')
    page.script("[...document.querySelectorAll('.chip')]"
                ".filter(chip => !/sensor status|mcu$/.test(chip.firstChild.textContent)"
                " && chip.ariaPressed == 'true').forEach(chip => chip.click())")
    page.wait(lambda page: set(page.texts('.frame-link')) == {'mcu \u2190'},
              'only the sensor board is shown')
    page.script("document.querySelector('.frame').click()")
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


def test_a_plot_zooms_pauses_and_shows_values_at_the_cursor_by_keyboard(page):
    note = '#card-motion .figure .span'
    page.wait_for_text(note, '20 s')        # 50 samples a second
    page.script("document.querySelector('#card-motion canvas').focus()")
    for key, text in (('+', '10 s'), ('-', '20 s'), ('-', '60 s')):
        page.press(key)
        page.wait_for_text(note, text)
    page.press(LEFT)
    values = r'[0-9.]+ s ago: x .*, y .*, z .*'
    page.wait(lambda page: re.fullmatch(values, page.text(note)), 'the values are shown')
    page.press(' ')
    page.wait(lambda page: re.fullmatch('paused, ' + values, page.text(note)), 'it is paused')
    shown = page.text(note)
    page.wait(lambda page: page.text(note).partition(':')[0] != shown.partition(':')[0],
              'the paused time gets older')
    assert page.text(note).partition(':')[2] == shown.partition(':')[2]     # but the values stay
    page.press(ESCAPE)
    page.wait_for_text(note, '60 s')
    page.hover('#card-motion canvas')
    page.wait(lambda page: re.fullmatch(values, page.text(note)), 'pointing shows them, too')


class SimulatedBridge:
    """A bridge that this process simulates, and a panel for it, until a test ends."""

    def __init__(self, browser, folder):
        self._browser, self._folder = browser, str(folder)
        self._stack = contextlib.ExitStack()

    def set(self, name, value):
        """Set a parameter."""
        rospy.set_param(name, value)
        self._stack.callback(rospy.delete_param, name)

    def topic(self, name, kind, message=None):
        """Return a publisher; with a message, it is latched."""
        topic = rospy.Publisher(name, kind, queue_size=1, latch=message is not None)
        self._stack.callback(topic.unregister)
        if message is not None:
            topic.publish(message)
        return topic

    def service(self, name, kind, answer):
        """Serve it."""
        self._stack.callback(rospy.Service(name, kind, answer).shutdown)

    def repeat(self, function):
        """Call it 20 times a second."""
        self._stack.callback(rospy.Timer(rospy.Duration(0.05), lambda _event: function()).shutdown)

    def report(self, status):
        """Report the status of a link."""
        topic = self.topic('/diagnostics', DiagnosticArray)
        self.repeat(lambda: topic.publish(DiagnosticArray(status=[status])))

    def package(self, name, text):
        """Make a package that the panel can import."""
        os.mkdir(os.path.join(self._folder, name))
        with open(os.path.join(self._folder, name, '__init__.py'), 'w') as file:
            file.write(text)

    def open(self, name, *arguments):
        """Show the page of a panel."""
        panel = Panel(*arguments, '--node', rospy.get_name(), name=name, environment={
            'PYTHONPATH': f'{self._folder}:{os.environ["PYTHONPATH"]}'})
        self._stack.callback(panel.end)
        self._stack.callback(self._browser.open, 'about:blank')
        self._browser.open(panel.url)
        self._browser.wait_for_text('#connection', 'live')

    def close(self):
        """End all of it."""
        with self._stack:
            assert self._browser.errors() == []


@pytest.fixture
def bridge(chromium, core, tmp_path):
    bridge = SimulatedBridge(chromium, tmp_path)
    yield bridge
    bridge.close()


def test_custom_topics_appear_and_vanish(chromium, bridge):
    wind, words = bridge.topic('~wind', Vector3), bridge.topic('~motto', String)
    colour = bridge.topic('~colour', ColorRGBA)
    bridge.repeat(lambda: (wind.publish(1.5, -2.25, 1.25e-9), colour.publish(1, 2, 3, 4),
                           words.publish('<b>semper idem</b>')))
    bridge.open('panel_custom')
    card = '[data-custom="~wind"] '
    chromium.wait_for_text('[data-reading="~wind:y"] .number', '\N{MINUS SIGN}2.25')
    assert chromium.text('[data-reading="~wind:x"] .number') == '1.5'
    assert chromium.text('[data-reading="~wind:z"] .number') == '1.25e\N{MINUS SIGN}9'
    assert len(chromium.all(card + 'canvas')) == 1      # the parts of one vector
    chromium.wait_for_text('[data-reading="~colour:a"] .number', '4')
    assert len(chromium.all('[data-custom="~colour"] canvas')) == 4
    chromium.wait_for_text('[data-reading="~motto:data"] .number', '<b>semper idem</b>')
    assert not chromium.all('[data-custom="~motto"] canvas')
    # A range whose limits are not finite, as another program may publish it.
    bridge.topic('~odd', Range, Range(min_range=float('nan'), max_range=float('inf'), range=0.25))
    later = bridge.topic('~later', Float32, Float32(7.0))
    chromium.wait_for_text('[data-reading="~odd:range"] .number', '0.250')
    chromium.wait_for_text('[data-reading="~later:data"] .number', '7')
    later.unregister()
    chromium.wait(lambda page: not page.all('[data-custom="~later"]'), 'the card vanishes')


def test_extreme_numbers_and_names_do_no_harm(chromium, bridge):
    values = {'big': (Int64, 2 ** 43), 'bigger': (Int64, 2 ** 63 - 1),
              'huge': (Float64, 1.7e308), 'least': (Float64, -1.7e308), 'level': (Float64, 1e300)}
    publishers = [(bridge.topic('~' + name, kind), number)
                  for name, (kind, number) in values.items()]
    causes = {'constructor': '3', '__proto__': '4', 'x' * 5000: '5', 'square': '\u00b2'}
    status = DiagnosticStatus(name='odd: constructor link', message='m' * 5000, values=[
        KeyValue(f'{cause} errors', count) for cause, count in causes.items()]
        + [KeyValue('port', 'p' * 5000), KeyValue('timeouts', 't' * 5000)])

    def publish():
        for publisher, number in publishers:
            publisher.publish(number)
        for pair in status.values[:2]:
            pair.value = str(int(pair.value) + 1)
    bridge.repeat(publish)
    bridge.report(status)
    bridge.open('panel_odd')
    for name, text in (('big', str(2 ** 43)), ('bigger', str(2 ** 63 - 1)),
                       ('huge', '1.7e+308'), ('least', '\N{MINUS SIGN}1.7e+308')):
        chromium.wait_for_text(f'[data-reading="~{name}:data"] .number', text)
    chromium.wait_for_updates(20)       # so that all are drawn
    card = '[data-link="constructor"] '
    for cause in ('constructor', '__proto__'):
        chromium.wait(lambda page, cause=cause: int(page.text(
            f'{card} [data-cause="{cause}"] b') or 0) > 0, f'{cause} is counted')
    assert 'function' not in chromium.text(card)
    assert chromium.script('return document.documentElement.scrollWidth <= innerWidth')
    with phone(chromium):
        chromium.wait(lambda page: page.script(
            'return document.documentElement.scrollWidth') == PHONE[0], 'it fits')


def test_an_error_is_still_counted_when_its_warning_is_over(page):
    """The error of test_an_error_is_shown_and_counted_by_its_cause, after 10 s."""
    card = '[data-link="mcu"]'
    wait_for_attribute(page, card, 'data-health', 'ok')
    assert 'checksum' in page.text(card + ' .causes')


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


def test_on_a_phone_commands_and_drive_are_one_tab_each_and_stop_is_always_in_sight(control_page):
    page = control_page
    with phone(page):
        tabs = [tab for tab in page.texts('.tabs button') if tab]
        assert tabs == ['Links', 'Drive', 'Commands', 'Car', 'Sensors', 'Wire']
        for tab in tabs:
            page.script("[...document.querySelectorAll('.tabs button')]"
                        ".find(b => b.textContent == arguments[0]).click()", tab)
            page.script('scrollTo(0, document.body.scrollHeight)')
            page.wait_for_updates(2)
            assert page.script('return document.documentElement.scrollWidth') == PHONE[0]
            assert all(top >= 0 and bottom <= PHONE[1] for top, bottom in page.script(
                "return [...document.querySelectorAll('#stop, .tabs button')]"
                ".map(e => e.getBoundingClientRect()).map(box => [box.top, box.bottom])"))
            shown = {card.get_attribute('data-tab') for card in page.all('main [data-tab]')
                     if card.is_displayed()}
            assert shown == {tab}
            if tab == 'Drive':
                assert page.script("return document.getElementById('pad')"
                                   ".getBoundingClientRect().bottom") < PHONE[1] - 60
        page.script("document.querySelector('.tabs button').click()")


def test_a_long_name_of_a_port_is_shortened_in_its_middle(page, robot):
    port = '[data-link="mcu"] .port'
    with phone(page):
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


_SMALL = '''
    return [...document.querySelectorAll('button, input, summary, [tabindex], select, a')]
      .filter(e => e.checkVisibility() && !e.disabled).map(e => [e.outerHTML.slice(0, 80),
        e.getBoundingClientRect()]).filter(([, box]) => box.width < 24 || box.height < 24)
      .map(([what]) => what);'''


# The texts with a contrast below 4.5 (WCAG AA). Links are shown in the given health.
_FAINT = r'''
    const health = arguments[0];
    document.querySelectorAll('.link').forEach(e => { e.dataset.health = health; });
    const canvas = document.createElement('canvas').getContext('2d', {willReadFrequently: true});
    const rgba = (colour) => {
      canvas.clearRect(0, 0, 1, 1); canvas.fillStyle = colour; canvas.fillRect(0, 0, 1, 1);
      return [...canvas.getImageData(0, 0, 1, 1).data];
    };
    const behind = (e) => {
      for (; e; e = e.parentElement) {
        const found = rgba(getComputedStyle(e).backgroundColor);
        if (found[3] === 255) return found;
      }
      return rgba('white');
    };
    const light = ([r, g, b]) => [r, g, b].map(v => v / 255).map(v => v <= 0.04045 ? v / 12.92
      : ((v + 0.055) / 1.055) ** 2.4)
      .reduce((sum, v, at) => sum + v * [0.2126, 0.7152, 0.0722][at], 0);
    const texts = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT), faint = [];
    while (texts.nextNode()) {
      const e = texts.currentNode.parentElement, text = texts.currentNode.textContent.trim();
      if (!text || !e.checkVisibility() || e.closest('.visually-hidden, :disabled')) continue;
      const [a, b] = [light(rgba(getComputedStyle(e).color)), light(behind(e))];
      const contrast = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
      if (contrast < 4.5) faint.push(`${contrast.toFixed(2)} ${e.className} ${text.slice(0, 40)}`);
    }
    return faint;'''


def test_every_target_is_at_least_24_px_large_and_every_text_has_enough_contrast(control_page):
    assert control_page.script(_SMALL) == []
    with phone(control_page):
        assert control_page.script(_SMALL) == []
    backgrounds = []
    for scheme in ('dark', 'light'):        # as the system has it
        control_page.scheme(scheme)
        backgrounds.append(control_page.script(
            'return getComputedStyle(document.body).backgroundColor'))
        for health in ('ok', 'warn', 'error', 'none'):
            assert control_page.script(_FAINT, health) == [], (scheme, health)
    assert backgrounds == ['rgb(14, 17, 20)', 'rgb(243, 244, 246)']


def test_every_control_is_reached_by_tab_and_has_a_name(control_page):
    wanted = control_page.script(
        "return [...document.querySelectorAll('button, input, summary, [tabindex]')]"
        ".filter(e => e.checkVisibility() && !e.disabled).length")
    control_page.script("document.activeElement.blur(); window.reached = new Set();"
                        "document.addEventListener('focusin', e => reached.add(e.target))")
    for _ in range(wanted + 5):
        control_page.press('\ue004')
    assert control_page.script('return reached.size') >= wanted
    nameless = [node for node in control_page.accessibility() if node['role']['value'] in (
        'button', 'textbox', 'spinbutton', 'slider', 'meter', 'image', 'region', 'application')
        and not node.get('name', {}).get('value')]
    assert nameless == []


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
    assert not robot.lift_requests and control_page.all(up + ':enabled')
    control_page.double_click(up)
    control_page.wait(lambda page: 'done' in page.text('.answers'), 'the answer is shown')
    control_page.wait(lambda page: page.all(up)[0].is_enabled(), 'the button is enabled again')
    assert [request.data for request in robot.lift_requests] == [bytes((0, 20))]
    assert 'lift up 20 mm done' in control_page.text('.answers li')


def test_a_control_is_disabled_until_its_call_is_answered(control_page, robot):
    robot.bus.script.append(b'')        # no answer until the timeout
    down = '[data-service="~lift"] button:last-of-type'
    # Checked at the same moment: the call is under way for a second.
    press(control_page, down, lambda page: page.script(
        "return document.querySelector('.answers').innerText.includes('under way') &&"
        "[...document.querySelectorAll('[data-service=\"~lift\"] button')]"
        ".every(button => button.disabled)"), 'it is under way, and every button is disabled')
    wait_for_attribute(control_page, '.answers li', 'data-outcome', 'not known')
    control_page.wait(lambda page: page.all(down)[0].is_enabled(), 'the button is enabled again')
    assert 'not known' in control_page.text('.answers li .outcome')
    assert 'look before you repeat it' in control_page.text('.answers li')
    assert len(robot.lift_requests) == 1


def press(page, button, holds, what):
    """Press a button until `holds(page)`: again if nothing was sent, as on a busy machine."""
    def press_again():
        answers = page.texts('.answers li')
        if answers and 'nothing was sent' in answers[0] and page.all(button + ':enabled'):
            page.click(button)

    page.click(button)
    page.wait(holds, what, doing=press_again)


def drop_connection(page, network):
    """Cut the connection, and restore it when the page has noticed."""
    network.cut()
    page.wait_for_text('#connection', 'no connection')
    network.restore()
    page.wait_for_text('#connection', 'live')
    page.errors()      # the console reports the lost connection, as it should


def test_the_outcome_is_not_known_if_the_connection_is_lost(control_page, robot, network):
    robot.bus.script.append(b'')
    press(control_page, '[data-service="~lift"] button', lambda _page: robot.lift_requests,
          'the board has received it')
    drop_connection(control_page, network)
    control_page.wait(lambda page: any(
        'the connection was lost before the answer was received' in each
        for each in page.texts('.answers li')), 'the page shows it')
    until(lambda: control_page.all('[data-service="~lift"] button')[0].is_enabled(), 'it is over')


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


def test_a_page_that_only_looks_says_so_and_how_to_get_commands(page):
    page.wait(lambda page: 'This page only looks' in page.text('#card-commands'), 'it is shown')
    text = page.text('#card-commands')
    assert '--control' in text and 'control:=true' in text and 'tunnel' in text
    assert not any(each.is_displayed() for each in page.all('#stop, #pad, [data-service]'))


def test_stop_on_the_page_of_a_second_panel_stops_the_car(control_page, robot):
    """Each panel has a browser of its own; what is counted is what the board receives."""
    browser = Browser()
    try:
        with Panel('--control', '--token', TOKEN, name='panel_second') as second:
            browser.open(second.url)
            browser.wait_for_text('#connection', 'live')
            wait_until_settled(browser)

            def stopped_by_the_second():
                hold(control_page, robot)
                browser.click('#stop')
                wait_until_stopped(robot, control_page)         # and its pad is still pressed
                return '/panel_second commands the car' in control_page.text('#pad-words')
            again_if_stalled(stopped_by_the_second)
            control_page.release()

            # While the first drives, the second does not.
            def refused_beside_the_first():
                hold(control_page, robot)
                robot.car.forget()
                browser.release()
                browser.press_at('#pad', 0, 60)
                browser.wait_for_updates(15)
                return '/panel_control commands the car' in browser.text('#pad-words') \
                    and control_page.attribute('#pad', 'data-held') is not None
            again_if_stalled(refused_beside_the_first)
            assert min(robot.car.speeds, default=0) >= 0
            browser.release()
            control_page.release()
            wait_until_stopped(robot, control_page)
    finally:
        browser.quit()


def test_calibration_needs_a_confirmation(control_page, robot):
    packet = arduino.encode(arduino.ImuCalibration())
    control_page.click('[data-service="~calibrate_imu"] button')
    control_page.wait(lambda page: page.script("return document.querySelector('dialog').open"),
                      'the dialog is open')
    control_page.click('#stop')
    wait_for_answer(control_page, 'STOP sent')       # beside the dialog
    control_page.click('dialog button:last-of-type')
    assert packet not in robot.car.raw_commands
    control_page.click('[data-service="~calibrate_imu"] button')
    robot.sends = False          # as a board that calibrates
    try:
        control_page.click('dialog button')
        until(lambda: packet in robot.car.raw_commands, 'the board has received it')
        control_page.wait(lambda page: 'calibrating for' in page.text(
            '[data-service="~calibrate_imu"] .words'), 'the elapsed time is shown')
    finally:
        robot.sends = True
    control_page.wait(lambda page: page.text('[data-service="~calibrate_imu"] .words') == '',
                      'the calibration is over')


def test_a_button_of_the_led_sends_its_text(control_page, robot):
    brake = '[data-service="~led"] button:nth-of-type(3)'
    control_page.wait(lambda page: page.all(brake + ':enabled'),
                      'the status has no calibration any more')

    def press():
        if control_page.all(brake + ':enabled'):
            control_page.click(brake)
    wait_for_answer(control_page, 'LED brake sent', doing=press, every=0.7)
    assert arduino.LedCommand('brake') in robot.car.commands()


def test_the_reply_of_a_custom_function_is_shown_field_by_field(control_page, robot):
    robot.bus.script.append(bus.Reply(bus.OK, bytes.fromhex('d204 0000 b841')))
    press(control_page, '[data-service="~weigh"] button',
          lambda page: page.attribute('.answers li', 'data-outcome') == 'done', 'it is done')
    assert control_page.texts('.answers li:first-child .reply div') == [
        'environment.smoke\n1234', 'environment.temperature\n23', 'environment.humidity\n0']


def was_too_old(page):
    """Whether the latest command was refused for its age, as may happen on a busy machine."""
    return 'press again' in (page.text('.answers li') if page.all('.answers li') else '')


def test_a_custom_function_is_offered_and_hostile_names_are_shown_as_text(chromium, bridge):
    asked = []

    def press_again():
        button = chromium.all(form + 'button')[0]
        if was_too_old(chromium) and button.is_enabled():
            button.click()

    def pump(request):
        asked.append(request.data)
        return SetBoolResponse(request.data, 'the pump runs' if request.data
                               else Outcome(NOT_SENT, 'it is empty').text)
    # A row's name that the bridge itself would refuse.
    bridge.set('~bus/functions', {'pump': {'cmd2': 48, 'srv_type': 'std_srvs/SetBool'},
                                  HOSTILE: {'cmd2': 49, 'srv_type': 'std_srvs/Trigger'}})
    bridge.report(DiagnosticStatus(name='odd: bus link', message=HOSTILE, values=[
        KeyValue('port', HOSTILE), KeyValue(HOSTILE, HOSTILE), KeyValue(f'{HOSTILE} errors', '3')]))
    bridge.service('~pump', SetBool, pump)
    bridge.open('panel_functions', '--control')
    form = '[data-service="~pump"] '
    chromium.wait(lambda page: page.all(form + 'button'), 'the function is offered')
    for outcome in ('refused', 'done'):
        chromium.wait(lambda page: page.all(form + 'button')[0].is_enabled(), 'it is enabled')
        chromium.click(form + 'button')
        chromium.wait(lambda page: page.attribute('.answers li', 'data-outcome') == outcome
                      and not was_too_old(page), outcome, doing=press_again)
        chromium.click(form + 'input')
    assert asked == [False, True]
    answers = chromium.text('.answers')
    assert 'the pump runs' in answers and 'it is empty' in answers
    for place in '.summary', '.port', 'legend':
        assert any(HOSTILE in each for each in chromium.script(
            'return [...document.querySelectorAll(arguments[0])].map(e => e.textContent)',
            place)), place
    assert 'pwned' not in chromium.title
    assert chromium.all('main img') == chromium.all('main script') == []


_GAUGE = """
from serial_communication.boards.description import Description, Field, Service, Topic

DESCRIPTION = Description(
    'gauge', __name__, lambda sent, parameters: None, 'rain gauge',
    topics=(Topic('~rain', 'std_msgs/Float32', card='Weather'),
            Topic('~sun', 'sensor_msgs/Range', card='Weather'),
            Topic('~wind', 'geometry_msgs/Vector3')),
    services=(Service('~tilt', 'serial_communication/Lift', 'tilt the funnel', (
                  Field('distance', 'constructor', maximum=30, preset=3),
                  Field('direction', choices=(('\u25b2 out', 0), ('\u25bc in', 1))))),
              Service('~empty', 'std_srvs/Trigger', 'empty', confirm='Its water runs out.'),
              Service('~unknown', 'nowhere/Type', 'unknown')))
"""


def test_services_and_cards_of_a_fourth_board_are_those_of_its_description(chromium, bridge):
    asked = []
    bridge.package('wet_gauge', _GAUGE)
    bridge.set('~boards', ['wet_gauge'])
    bridge.topic('~rain', Float32, Float32(4.5))
    bridge.topic('~sun', Range, Range(min_range=0, max_range=2, range=0.5))
    bridge.topic('~wind', Vector3, Vector3(1, 2, 3))
    bridge.report(DiagnosticStatus(name='odd: gauge link', message='ready',
                                   values=[KeyValue('port', 'none')]))
    bridge.service('~tilt', Lift, lambda request: LiftResponse(
        success=not asked.append((request.direction, request.distance))))
    bridge.service('~empty', Trigger, lambda _request: TriggerResponse(
        not asked.append('empty'), 'it is empty'))
    bridge.open('panel_gauge_forms', '--control')
    chromium.focus()
    tilt = '[data-service="~tilt"] '
    chromium.wait(lambda page: page.all(tilt + 'button:enabled'), 'its service is offered')
    assert chromium.text(tilt + 'legend') == 'tilt the funnel'
    assert chromium.texts(tilt + 'button') == ['\u25b2 out', '\u25bc in']
    assert chromium.text(tilt + 'label') == 'constructor'        # a unit may have any name
    assert chromium.attribute(tilt + 'input', 'max') == '30'
    assert not chromium.all('[data-service="~unknown"]')
    chromium.click(tilt + 'button:last-of-type')
    wait_for_answer(chromium, 'tilt the funnel in 3 constructor done')
    chromium.click('[data-service="~empty"] button')
    assert chromium.text('[data-service="~empty"] dialog p') == 'Its water runs out.'
    chromium.click('[data-service="~empty"] dialog button')
    chromium.wait(lambda page: 'it is empty' in page.text('.answers li'), 'it is called, too')
    assert asked == [(1, 3), 'empty']
    # Topics of one card, a value with limits as a bar; and one with a card of its own.
    weather = '[data-custom="Weather"] '
    chromium.wait_for_text(weather + '[data-reading="~rain:data"] .number', '4.5')
    chromium.wait_for_text(weather + '[data-range="~sun:range"] .number', '0.500 m')
    chromium.wait_for_text('[data-custom="~wind"] [data-reading="~wind:y"] .number', '2')


def test_what_was_entered_stays_when_another_form_appears(control_page, robot):
    entered = '[data-service="~gripper"] input'
    control_page.script("document.querySelector(arguments[0]).value = '7'", entered)
    row = {'cmd2': 0x35, 'srv_type': 'std_srvs/Trigger'}
    rospy.set_param(NODE + '/bus/announced', {'horn': row})
    try:
        control_page.wait(lambda page: page.all('[data-service="~horn"] button'), 'it appears')
        assert control_page.script('return document.querySelector(arguments[0]).value',
                                   entered) == '7'
        assert control_page.texts('.commands fieldset legend')[-1].startswith('horn')
    finally:
        rospy.delete_param(NODE + '/bus/announced')
    control_page.wait(lambda page: not page.all('[data-service="~horn"]'), 'it vanishes')


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
    until(drives, 'the car drives', doing=press, every=0.6)     # a double click would not drive


def wait_until_stopped(robot, page):
    until(lambda: robot.car.speeds[-1] == 0, 'the car stops')
    page.wait(lambda page: page.attribute('#pad', 'data-held') is None, 'the hold ends')
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


# Each is a context in which the pad is pressed.
ENDS = {
    'the pad is released': released,
    'another control gets the focus': scripted("document.getElementById('speed-limit').focus()"),
    'the window loses the focus': scripted("window.dispatchEvent(new Event('blur'))"),
    'the tab is hidden': Browser.other_tab, 'the page hangs': scripted(
        'const end = performance.now() + 1500; while (performance.now() < end);'),
    'the browser is frozen': Browser.frozen}


def test_whatever_ends_a_hold_stops_the_car(control_page, robot):
    for what, end in ENDS.items():
        robot.car.forget()
        hold(control_page, robot)
        with end(control_page):
            until(lambda: robot.car.speeds[-1] == 0, f'{what}: the car stops')
        wait_until_stopped(robot, control_page)
        control_page.release()
    control_page.errors()       # it was frozen


def test_a_lost_connection_stops(control_page, robot, network):
    hold(control_page, robot)
    drop_connection(control_page, network)
    wait_until_stopped(robot, control_page)
    control_page.release()


def test_commands_delayed_by_the_network_do_not_drive(control_page, robot, network):
    hold(control_page, robot)
    network.delay()
    try:
        until(lambda: robot.car.speeds[-1] == 0, 'the car stops')
        control_page.wait(lambda page: page.attribute('#pad', 'data-held') is None, 'the hold ends')
        control_page.release()
        # Pressed again while nothing is delivered, the page sends nothing or what is too old.
        control_page.press_at('#pad', 0, -60)
        control_page.release()
        robot.car.forget()
    finally:
        network.deliver()
    control_page.wait_for_text('#connection', 'live')
    control_page.wait_for_updates(15)
    assert not any(robot.car.speeds)


def test_a_panel_that_sends_no_updates_stops(control_page, robot, control_panel):
    hold(control_page, robot)
    with suspended(control_panel.process.pid):
        control_page.wait(lambda page: page.attribute('#pad', 'data-held') is None, 'the hold ends')
        assert control_page.text('#pad-words').startswith('stopped: ')
        until(lambda: robot.car.speeds[-1] == 0, 'the bridge stops the car')
    control_page.wait_for_text('#connection', 'live')
    wait_until_stopped(robot, control_page)
    control_page.release()
    control_page.errors()    # it may have tried to reconnect


def test_a_panel_that_was_stopped_for_long_gives_no_false_reason(control_page, control_panel):
    control_page.script("""window.troubles = new Set();
        new MutationObserver(() => troubles.add(document.getElementById('trouble').textContent))
            .observe(document.getElementById('trouble'), {childList: true});""")
    with suspended(control_panel.process.pid):
        control_page.wait(lambda page: re.search(
            r'for ([6-9]\.|\d\d )', page.text('#trouble')), 'it gave up and retries')
    control_page.wait_for_text('#connection', 'live')
    troubles = ' '.join(control_page.script('return [...troubles]'))
    assert 'no connection to the panel' in troubles
    assert 'pages are open' not in troubles and 'token' not in troubles
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


SHIFT, META = 8, 4       # as Input.dispatchKeyEvent has them


def press_ahead(page, **more):
    """Press the key for ahead, and hold it."""
    page.key_event('keyDown', 'ArrowUp', 'ArrowUp', **more)


def hold_ahead(page, robot):
    """Drive by the key for ahead, as `hold` does by the pad."""
    def press():
        if page.attribute('#pad', 'data-held') is None:
            page.key_event('keyUp', 'ArrowUp', 'ArrowUp')
            press_ahead(page)
    page.script("document.getElementById('pad').focus()")
    until(lambda: 200 in robot.car.speeds and page.attribute('#pad', 'data-held') is not None,
          'the car drives', doing=press, every=0.3)


def test_keys_that_do_not_drive(control_page, robot):
    """The keypad: with NumLock and Shift, a key can be pressed as an arrow and released as the
    digit 8. A key with a modifier: macOS does not report its release while Cmd is held."""
    control_page.script("document.getElementById('pad').focus()")
    keypad = {'location': 3, 'isKeypad': True}
    control_page.key_event('keyDown', 'Shift', 'ShiftLeft', modifiers=SHIFT, location=1)
    control_page.key_event('keyDown', 'ArrowUp', 'Numpad8', modifiers=SHIFT, **keypad)
    control_page.key_event('keyUp', 'Shift', 'ShiftLeft', location=1)
    control_page.key_event('keyUp', '8', 'Numpad8', **keypad)
    control_page.wait_for_updates(15)
    for modifier in META, SHIFT:
        press_ahead(control_page, modifiers=modifier)
        control_page.wait_for_updates(15)
        assert control_page.attribute('#pad', 'data-held') is None
        control_page.key_event('keyUp', 'ArrowUp', 'ArrowUp')
    assert not any(robot.car.speeds)


def test_pressing_or_releasing_any_other_key_stops(control_page, robot):
    for what, key, code, more in (
            ('keyDown', 'Meta', 'MetaLeft', {'modifiers': META}), ('keyDown', 'x', 'KeyX', {}),
            ('keyUp', '8', 'Numpad8', {}), ('keyUp', 'ArrowUp', 'Numpad8', {})):
        robot.car.forget()
        hold_ahead(control_page, robot)
        control_page.key_event(what, key, code, **more)
        wait_until_stopped(robot, control_page)
        press_ahead(control_page, autoRepeat=True)       # it is still held and repeats
        wait_until_stopped(robot, control_page)
        control_page.key_event('keyUp', 'ArrowUp', 'ArrowUp')


def test_pad_and_keys_do_not_drive_together(control_page, robot):
    hold(control_page, robot)
    press_ahead(control_page)
    wait_until_stopped(robot, control_page)
    control_page.key_up(UP)
    control_page.release()
    hold_ahead(control_page, robot)
    control_page.press_at('#pad', 0, 60)
    wait_until_stopped(robot, control_page)
    assert min(robot.car.speeds) == 0
    control_page.release()
    control_page.key_up(UP)


def test_a_key_that_no_longer_repeats_counts_as_released(control_page, robot):
    hold_ahead(control_page, robot)
    press_ahead(control_page, autoRepeat=True)
    wait_until_stopped(robot, control_page)
    control_page.key_event('keyUp', 'ArrowUp', 'ArrowUp')
    # This system is now known to repeat keys: one that never begins to counts as released, too.
    hold_ahead(control_page, robot)
    wait_until_stopped(robot, control_page)
    control_page.key_event('keyUp', 'ArrowUp', 'ArrowUp')


def keeps_driving(page, robot, hold_keys, seconds=4.0):
    """Check that the car drives for this time without another event of the keyboard."""
    def held():
        return page.attribute('#pad', 'data-held') is not None

    def drives():
        hold_keys()
        began = time.monotonic()
        until(lambda: not held() or time.monotonic() - began > seconds, 'the time has passed')
        assert held() or 'repeats' not in page.text('#pad-words')
        return held()
    again_if_stalled(drives, tries=10)
    count = len(robot.car.speeds)
    until(lambda: len(robot.car.speeds) > count, 'another speed is received')
    assert robot.car.speeds[-1] == 200
    page.key_up(UP)
    wait_until_stopped(robot, page)


def test_a_held_key_drives_on_a_system_that_repeats_no_keys_or_only_another_one(control_page,
                                                                                robot):
    """Systems repeat only the key that was pressed last, and none after its release."""
    def ahead_and_once_right():
        hold_ahead(control_page, robot)
        press_ahead(control_page, autoRepeat=True)
        control_page.key_down(RIGHT)
        control_page.key_event('keyDown', 'ArrowRight', 'ArrowRight', autoRepeat=True)
        control_page.key_up(RIGHT)
    keeps_driving(control_page, robot, lambda: hold_ahead(control_page, robot))
    robot.car.forget()
    keeps_driving(control_page, robot, ahead_and_once_right)


# -- outages ----------------------------------------------------------------------------------


def test_commands_of_a_closed_link_are_disabled_with_the_reason(control_page, robot):
    page = control_page
    robot.lines['arduino'].unplug()
    try:
        page.wait(lambda page: page.script("""
            const all = (selector) => [...document.querySelectorAll(selector)];
            const services = ['~led', '~gripper', '~calibrate_imu'].map(
                (name) => `[data-service="${name}"]`);
            return all(services.map((each) => each + ' .reason, #pad-words').join()).every(
                    (each) => each.textContent === 'the arduino link is closed')
                && all(services.map((each) => each + ' > .controls button').join()).every(
                    (each) => each.disabled)
                && document.getElementById('pad').ariaDisabled === 'true';"""),
                  'its commands are disabled, with the reason')
        page.press_at('#pad', 0, -60)
        assert page.attribute('#pad', 'data-held') is None
        page.release()
        assert page.all('[data-service="~lift"] button')[0].is_enabled()
        assert page.all('#stop')[0].is_enabled()
    finally:
        robot.lines['arduino'].plug()
    page.wait(lambda page: page.text('[data-service="~led"] .reason') == ''
              and page.attribute('#pad', 'aria-disabled') is None, 'they are enabled again')


def test_the_page_shows_that_a_line_is_unplugged_and_plugged_in(page, robot):
    robot.lines['mcu'].unplug()
    card = '[data-link="mcu"]'
    wait_for_attribute(page, card, 'data-health', 'error')
    assert page.text(card + ' .summary').startswith('closed: ')
    range_1 = '[data-range="mcu/range_1:range"]'
    wait_for_attribute(page, range_1, 'data-state', 'stale')
    robot.lines['mcu'].plug()
    wait_for_attribute(page, card, 'data-health', 'ok')
    wait_for_attribute(page, range_1, 'data-state', 'fresh')


def test_the_page_shows_a_restart_of_the_bridge(page, robot):
    robot.bridge.end()
    page.wait(lambda page: 'no bridge ' + NODE in page.text('#trouble'), 'the page shows it')
    assert page.attribute('[data-link="bus"]', 'data-health') in ('none', 'ok')
    wait_for_attribute(page, '[data-link="bus"]', 'data-health', 'none')
    robot.start_bridge()
    page.wait(lambda page: page.text('#trouble') == '', 'the trouble is over')
    wait_for_attribute(page, '[data-link="bus"]', 'data-health', 'ok')
    wait_for_attribute(page, '[data-reading="~imu:roll"]', 'data-state', 'fresh')


def test_the_page_shows_a_restart_of_the_master(control_page, robot, core):
    page = control_page
    page.script("""window.alarms = [];
        new MutationObserver(() => alarms.push(document.getElementById('alarm').textContent))
            .observe(document.getElementById('alarm'), {childList: true});""")
    core.stop()
    page.wait(lambda page: 'no answer from the ROS master' in page.text('#trouble'),
              'the page shows it')
    assert page.text('#connection') == 'not live'
    page.wait(lambda page: 'no answer from the ROS master' in page.text(
        '[data-service="~lift"] .reason'), 'the reason is shown')
    assert not page.all('[data-service="~lift"] button')[0].is_enabled()
    shown = page.text('#trouble')
    page.wait(lambda page: page.text('#trouble') not in ('', shown), 'its age counts up')
    # A screen reader hears of it once, without the age that changes ten times a second.
    alarms = page.script('return alarms')
    assert len(alarms) == 1 and 'no answer from the ROS master' in alarms[0]
    core.start()
    page.wait(lambda page: page.text('#trouble') == '', 'the trouble is over')
    page.wait_for_text('#connection', 'live')
    # A new subscription works with the new master, too.
    page.click('#card-wire > summary')
    page.wait(lambda page: page.all('.frame'), 'serial_msg is received')
    page.click('#card-wire > summary')


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


def test_a_click_in_a_window_that_another_site_has_opened_moves_nothing(control_page, robot,
                                                                        network):
    """The key is in this browser, and the window appears under the pointer."""
    site = serve(f'''<button onclick="open('http://127.0.0.1:{network.port}/', 'w',
                     'popup,width=1200,height=900')">play</button>'''.encode())
    up, pad = '[data-service="~lift"] button', '#pad'
    control_page.open(f'http://localhost:{site.server_port}/')
    page = control_page

    def clicked_early():
        with page.window_opened_by('button'):
            page.script("window.clicks = []; document.addEventListener('pointerdown', (event) =>"
                        "clicks.push(event.timeStamp), true)")
            page.wait(lambda page: page.all(up), 'the controls appear')
            while not page.script('return clicks.length') or page.script(_EARLY) < 600:
                page.click_now(up)
                page.click_now(pad, 2)
            page.wait_for_updates(5)
            if page.script(_EARLY) >= 1000:     # this machine was too slow
                robot.bus.forget()
                robot.car.forget()
                return False
            assert not robot.lift_requests and not any(robot.car.speeds)
            page.click('#stop')
            wait_for_answer(page, 'STOP sent')        # at once
            wait_until_settled(page)
            page.click_now(up)
            until(lambda: robot.lift_requests, 'a click moves the lift when a second has passed')
            return True
    again_if_stalled(clicked_early, tries=10)
    site.shutdown()
    page.open(network.url)


# How long after the window was loaded the latest click was, ms.
_EARLY = ("return clicks[clicks.length - 1]"
          "- performance.getEntriesByType('navigation')[0].loadEventStart")


def test_the_pad_takes_no_second_press_of_a_double_click(control_page, robot):
    control_page.wait(lambda page: 'a double click' in page.text('#pad-words'), 'it says why',
                      doing=lambda: control_page.click_now('#pad', 2), every=0.7)
    control_page.wait_for_updates(15)
    assert control_page.attribute('#pad', 'data-held') is None


def test_after_the_focus_returns_no_command_is_taken_for_a_second(control_page, robot):
    clicked = control_page.script('''
        window.dispatchEvent(new Event('focus'));
        const button = document.querySelector('[data-service="~lift"] button');
        const wasEnabled = !button.disabled;
        button.click();
        return wasEnabled;''')
    assert clicked
    control_page.wait(lambda page: any('nothing was sent: the page has just appeared' in each
                                       for each in page.texts('.answers li')), 'it says so')
    control_page.wait(lambda page: page.text('[data-service="~lift"] .reason')
                      == 'the page has just appeared', 'with the reason beside the controls')
    wait_until_settled(control_page)
    assert not robot.lift_requests


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


def test_a_second_browser_with_a_used_address_is_told_one_thing(chromium):
    panel = Panel('--control', name='panel_used')
    try:
        assert panel.exchange(panel.token)[0] == 200        # by the first browser
        chromium.open('about:blank')
        chromium.open(panel.url)
        chromium.wait(lambda page: page.text('#trouble').startswith('the '), 'it shows the reason')
        chromium.script("""window.shown = new Set([document.getElementById('trouble').textContent]);
            new MutationObserver(() => shown.add(document.getElementById('trouble').textContent))
                .observe(document.getElementById('trouble'), {childList: true});""")
        before = panel.output().count('refused')
        chromium.wait(lambda _page: chromium.script('return window.tries ?? 0') > 2,
                      'it tries again', doing=lambda: chromium.script(
            "window.tries = performance.getEntriesByType('resource')"
            ".filter((each) => each.name.endsWith('/key')).length"))
        assert before and chromium.script('return [...shown]') == [
            'the token is wrong, or has been used already; '
            'open the address that the panel printed last']
    finally:
        chromium.open('about:blank')
        chromium.errors()
        panel.end()


def test_the_page_needs_the_token_once(chromium, control_panel, panel):
    chromium.open(control_panel.url)
    chromium.script('localStorage.clear()')
    chromium.open('about:blank')
    chromium.open(control_panel.url.split('#')[0])
    chromium.wait(lambda page: 'open the address that the panel printed last' in page.text(
        '#trouble'), 'the page shows it')
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
