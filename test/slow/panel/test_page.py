"""What ends a hold of the pad, touch and keys, and outages, in a real browser."""
import contextlib
import time

import pytest
import rospy
from boards import again_if_stalled, until
from panel_browser import Browser
from robot import FUNCTIONS, NODE, Panel
from std_srvs.srv import SetBool
from test_smoke import choose, hold

from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.bus import wire as bus

HOSTILE = '<img src=x onerror=document.title="pwned"><script>document.title="pwned"</script>'
RIGHT, UP = ('ArrowRight', 39), ('ArrowUp', 38)


@pytest.fixture
def car(page, robot):
    """The board of the car, which the pad drives."""
    choose(page, 'car')
    robot.car.forget()
    return robot.car


def drives(car):
    return lambda: any(speed > 0 for speed in car.speeds)


def has_stopped(car):
    """The bridge's own SPEED 0, after a stall, is followed by the next command of the pad."""
    return lambda: car.speeds[-1] == 0 and car.command_frames[-1].stamp < time.monotonic() - 0.3


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
    page.wait(lambda page: page.text('#pad-words') == 'stopped until STOP is released', 'it ends')
    until(lambda: stop(False).success, 'it is released')


# Each is a context that ends the hold of the pad.
ENDS = {
    'the pad is released': released,
    'another control gets the focus': scripted("document.querySelector('select').focus()"),
    'the window loses the focus': scripted("window.dispatchEvent(new Event('blur'))"),
    'the tab is hidden': Browser.other_tab,
    'the page hangs': scripted(
        'const end = performance.now() + 1500; while (performance.now() < end);'),
    'another program calls ~stop': stopped}


@pytest.mark.parametrize('what', ENDS)
def test_whatever_ends_a_hold_stops_the_car(page, car, what):
    hold(page, drives(car))
    with ENDS[what](page):
        until(has_stopped(car), 'the car stops')
    page.wait(lambda page: page.attribute('#pad', 'data-held') is None, 'the hold ends')
    until(has_stopped(car), 'it does not drive again')
    page.release()


def test_the_car_stops_when_the_panel_ends(chromium, robot):
    with Panel('--control', name='panel_ending') as panel:
        chromium.open(panel.url)
        chromium.wait_for_text('#connection', 'live')
        choose(chromium, 'car')
        robot.car.forget()
        hold(chromium, drives(robot.car))
    until(has_stopped(robot.car), 'the car stops')
    chromium.release()
    chromium.open('about:blank')
    chromium.errors()       # it tried to connect again


def touch(page, kind, selector='#pad', up=60):
    """Send a touch at this element."""
    x, y = page.script(
        "const box = document.querySelector(arguments[0]).getBoundingClientRect();"
        "return [box.left + box.width / 2, box.top + box.height / 2]", selector)
    page.driver.execute_cdp_cmd('Input.dispatchTouchEvent', {
        'type': kind, 'touchPoints': [{'x': x, 'y': y - up}] if kind != 'touchEnd' else []})


def test_a_long_press_of_a_finger_holds_and_its_end_stops(page, car):
    page.script("document.getElementById('pad').scrollIntoView({block: 'center'})")
    page.driver.execute_cdp_cmd('Emulation.setTouchEmulationEnabled', {'enabled': True})
    try:
        def held():
            car.forget()
            touch(page, 'touchStart')
            began = time.monotonic()
            until(drives(car), 'the car drives')
            page.script("document.getElementById('pad').dispatchEvent(new MouseEvent("
                        "'contextmenu', {bubbles: true, cancelable: true}))")     # as Android does
            until(lambda: time.monotonic() > began + 2, 'it is a long press')
            lasts = page.attribute('#pad', 'data-held') is not None
            touch(page, 'touchEnd')
            until(has_stopped(car), 'the car stops')
            return lasts and sum(speed > 0 for speed in car.speeds) > 20
        again_if_stalled(held, 20)
    finally:
        page.driver.execute_cdp_cmd('Emulation.setTouchEmulationEnabled', {'enabled': False})


def test_each_of_many_taps_drives_and_stops(page, car):
    page.script("document.getElementById('pad').scrollIntoView({block: 'center'})")

    def tapped():
        car.forget()
        for _ in range(9):
            began = time.monotonic()
            touch(page, 'touchStart')
            until(lambda: time.monotonic() > began + 0.15)
            touch(page, 'touchEnd')
            until(lambda: time.monotonic() > began + 0.33)
        until(has_stopped(car), 'the car stops')
        changes = [speed > 0 for speed in car.speeds]
        return sum(now and not before for before, now in zip([False] + changes, changes)) == 9
    again_if_stalled(tapped, 20)


def test_stop_is_sent_as_soon_as_it_is_pressed_and_once(page):
    """A touch that slips or stays, or of a second finger, makes no click."""
    assert page.script("""
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
        return counts;""") == [1, 1]
    page.wait(lambda page: page.attribute('#stop', 'aria-pressed') == 'true', 'it holds')
    page.click('#go')
    page.wait(lambda page: page.attribute('#stop', 'aria-pressed') == 'false', 'it is released')


def test_arrow_keys_drive_and_any_other_key_stops(page, car):
    page.script("document.getElementById('pad').focus()")

    def turns():
        return arduino.SteeringCommand(1900) in car.commands() and 200 in car.speeds

    def press():
        if page.attribute('#pad', 'data-held') is None:
            for what, key in ('Up', RIGHT), ('Up', UP), ('Down', UP), ('Down', RIGHT):
                page.key(what, *key)
    until(turns, 'the car drives', doing=press, every=0.3)
    page.key('Down', 'x', 88)
    until(has_stopped(car), 'the car stops')
    page.key('Up', *RIGHT)
    page.key('Up', *UP)


def test_a_setting_is_sent_by_its_slider_always_the_last_value(page, robot):
    form = '[data-form="~settings/arduino/kp"] '
    page.wait(lambda page: page.all(form + 'input[type=range]'), 'it is there')
    page.script("""
        const slider = document.querySelector(arguments[0]);
        for (const value of [1, 2, 3, 4.5]) {
            slider.value = value;
            slider.dispatchEvent(new Event('input'));
            slider.dispatchEvent(new Event('change'));
        }""", form + 'input[type=range]')
    page.wait(lambda page: page.text('.answers').count('kp') >= 2, 'two answers: first and last')
    page.wait(lambda page: rospy.get_param(NODE + '/settings/arduino/kp', 0) == 4.5,
              'the last value is wanted')


def test_halt_interrupts_a_lift_and_both_outcomes_are_shown(page, robot):
    page.wait(lambda page: page.all('[data-form="~lift"] button:enabled'), 'it may be called')
    robot.bus.forget()
    robot.bus.rule = lambda request: b'' if request.cmd2 == bus.LIFT else None     # it moves on
    try:
        page.click('[data-form="~lift"] button')
        until(lambda: robot.bus.asked(bus.LIFT) == [bytes((0, 20))], 'the board moves its lift')
        page.wait(lambda page: 'lift 20 mm ▲ up under way' in page.text('.answers'), 'it is shown')
        page.click('[data-form="~halt"] button')
        page.wait(lambda page: 'halt done: halt' in page.text('.answers')
                  and 'up not known: halt was sent' in page.text('.answers'), 'both outcomes')
    finally:
        robot.bus.rule = lambda request: None
    assert len(robot.bus.asked(bus.LIFT)) == 1 and robot.bus.asked(FUNCTIONS['halt']['cmd2'])


# -- outages and others -----------------------------------------------------------------------


def test_markup_in_a_text_is_shown_as_text(page, robot):
    page.script("document.querySelector('.wire').open = true")
    page.wait(lambda page: HOSTILE in page.text('.log') and HOSTILE in page.text('.frames'),
              'log and wire show it', doing=lambda: robot.car.say(arduino.LOGS[2](HOSTILE)),
              every=0.3)
    assert page.all('.log img') == page.all('.frames img') == page.all('.log script') == []
    assert 'pwned' not in page.driver.title


def test_the_page_goes_on_at_a_new_master(page, core):
    core.end()
    page.wait(lambda page: 'no answer from the ROS master' in page.text('#trouble'), 'it shows it')
    core.start()
    page.wait(lambda page: page.text('#trouble') == '', 'the trouble is over')
    page.wait(lambda page: page.attribute('[data-topic="~imu"]', 'data-state') == 'fresh', 'data')
    page.errors()       # the panel starts again, too, and refuses connections for a moment
