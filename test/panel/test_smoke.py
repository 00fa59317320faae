"""The page in a real browser, with bytes at the board: what a newcomer tries first."""
import contextlib
import re
import time

import rospy
from boards import until
from geometry_msgs.msg import Twist, Vector3
from robot import NODE

from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.bus import wire as bus


@contextlib.contextmanager
def driving(speed):
    """Inside this block, another program publishes a Twist at 20 Hz; gives how often it did."""
    sent, topic = [], rospy.Publisher(NODE + '/cmd_vel', Twist, queue_size=1)

    def drive(_event):
        topic.publish(Twist(linear=Vector3(x=speed)))
        sent.append(time.monotonic())
    timer = rospy.Timer(rospy.Duration(0.05), drive)
    try:
        yield sent
    finally:
        timer.shutdown()
        topic.unregister()


def choose(page, motion):
    """Choose what the pad drives."""
    page.wait(lambda page: page.script("""
        const choice = document.querySelector('select');
        choice.value = arguments[0];
        if (choice.value) choice.dispatchEvent(new Event('change'));
        return choice.value;""", motion), f'{motion} is chosen')


def hold(page, drives, right=0, up=60):
    """Press the pad until the board is driven; again where a stall of this machine ended it."""
    def press():
        if page.attribute('#pad', 'data-held') is None:
            page.release()
            page.press_at('#pad', right, -up)
    page.wait(lambda _page: drives(), 'the board is driven', doing=press, every=0.3)


def test_the_values_of_the_boards_are_shown(page):
    page.wait(lambda page: re.match(r'\d\.\d', page.text('[data-topic="~voltage"] .value')),
              'the voltage')
    page.wait(lambda page: page.attribute('[data-link="bus"]', 'data-health') == 'ok', 'the bus')
    page.wait(lambda page: page.all('[data-topic="~imu"] .uplot'), 'the attitude is plotted')
    assert page.script('return location.hash') == ''


def test_a_form_calls_a_service(page, robot):
    page.wait(lambda page: page.all('[data-form="~lift"] button:enabled'), 'it may be called')
    page.click('[data-form="~lift"] button')
    page.wait(lambda page: 'done: lift up 20 mm' in page.text('.answers'), 'the answer')
    assert robot.bus.asked(bus.LIFT)[-1:] == [bytes((0, 20))]


def test_stop_holds_against_another_program_until_another_page_releases_it(page, panel, robot):
    with driving(0.5) as sent:
        until(lambda: (0.5, 0) in robot.twists, 'another program drives')
        page.click('#stop')
        page.wait(lambda page: page.attribute('#stop', 'aria-pressed') == 'true', 'it holds')
        until(lambda: (0, 0) in robot.twists, 'the board gets the zero')
        since = len(sent)
        until(lambda: len(sent) > since + 40, 'the other program goes on')
        twists = robot.twists
        assert set(twists[twists.index((0, 0)):]) == {(0, 0)}
        with page.other_tab():
            page.open(panel.url)
            page.wait(lambda page: page.text('#trouble') == 'stopped until STOP is released',
                      'the other page shows it')
            page.click('#go')
            robot.car.forget()
            until(lambda: (0.5, 0) in robot.twists, 'it moves again')
    page.wait(lambda page: page.attribute('#stop', 'aria-pressed') == 'false', 'it is released')


def test_the_pad_drives_the_base_and_the_car(page, robot):
    def ahead_left():
        return any(forward > 0 and turn > 0 for forward, turn in robot.twists)
    choose(page, '~cmd_vel')
    hold(page, ahead_left, right=-40)
    page.release()
    until(lambda: robot.twists[-1] == (0, 0), 'the base stops')
    choose(page, 'car')
    hold(page, lambda: any(speed > 0 for speed in robot.car.speeds) and any(
        isinstance(each, arduino.SteeringCommand) and each.value > 1500
        for each in robot.car.commands()), right=40)
    page.release()
    until(lambda: robot.car.speeds[-1] == 0, 'the car stops')
