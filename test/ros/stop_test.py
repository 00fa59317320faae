#!/usr/bin/python3
"""~stop by ROS: another program drives on, and the board gets zeros until the stop is released."""
import threading

import rospy
import rostest
from geometry_msgs.msg import Twist
from std_srvs.srv import SetBool, Trigger

from boards import (NOT_SENT, PACKAGE, WARN, BoardsTest, BusBoard, CarBoard, Diagnostics,
                    command_topic, service, until)
from serial_communication.boards.arduino import wire as arduino
from serial_communication.boards.bus import wire as bus
from serial_communication.framing.layout import Value, message_class
from serial_communication.srv import Lift

NODE = '/' + PACKAGE
DRIVE = {'type': 40, 'direction': 'to_board', 'ros_type': 'geometry_msgs/Twist',
         'layout': '<hh', 'fields': ['linear.x', 'angular.z'], 'scale': 0.001}
HALT = {'cmd2': 0x30, 'srv_type': 'std_srvs/Trigger', 'repeatable': True, 'interrupts': True}
Drive = message_class('Drive', 40, '<hh', [Value('x', '', 0.001), Value('z', '', 0.001)])
HALT_REQUEST = bus.Request(bus.FUNCTION, 0x30)


class StopTest(BoardsTest):
    """A car with a motion of its own, a control board with a stop of its own, and a driver."""

    def setUp(self):
        super().setUp()
        self.car = self.plug('arduino', CarBoard, messages=(Drive,))
        self.board = self.plug('bus', BusBoard)
        self.start_bridge(parameters={
            'arduino/port': self.lines['arduino'].near, 'arduino/messages': {'cmd_vel': DRIVE},
            'bus/port': self.lines['bus'].near, 'bus/functions': {'halt': HALT},
            'bus/environment_period': 0.0})
        self.stop = service(NODE + '/stop', SetBool)
        echo = service(NODE + '/bus/echo', Trigger)
        until(lambda: echo().success, 'the bus answers')
        self.drive(command_topic(NODE + '/cmd_vel', Twist))

    def drive(self, topic):
        """Publish a Twist at 20 Hz until the test ends."""
        command = Twist()
        command.linear.x, command.angular.z = 0.5, -0.1
        ended = threading.Event()

        def run():
            while not ended.wait(0.05):
                topic.publish(command)
        thread = threading.Thread(target=run, daemon=True)
        thread.start()
        self.addCleanup(thread.join)
        self.addCleanup(ended.set)

    def motions(self):
        """The motions that the board got, without the heartbeats."""
        return {tuple(each) for each in self.car.messages((Drive, arduino.SpeedCommand))}

    def test_a_stop_holds_while_another_program_drives_until_it_is_released(self):
        diagnostics = Diagnostics()
        until(lambda: (0.5, -0.1) in self.motions(), 'it drives')
        answer = self.stop(True)
        self.car.forget()       # what was under way
        self.assertTrue(answer.success, answer.message)
        until(lambda: HALT_REQUEST in self.board.moves(), 'the function that interrupts')
        self.car.wait_for_heartbeats(150)
        self.assertLessEqual(self.motions(), {(0,), (0.0, 0.0)})
        self.assertIn((0.0, 0.0), self.motions())
        lift = service(NODE + '/lift', Lift)(0, 10)
        self.assertEqual((lift.success, lift.status), (False, NOT_SENT))
        self.assertIn('stopped: call ~stop with data: false', lift.message)
        status = diagnostics.fresh('arduino', lambda status: status.keys['condition'] == 'stopped',
                                   'condition stopped')
        self.assertEqual(status.level, WARN)
        self.assertTrue(self.stop(False).success)
        until(lambda: (0.5, -0.1) in self.motions(), 'it drives again')
        self.assertNotIn(bus.LIFT_FUNCTION.make_request((0, 10)), self.board.moves())
        diagnostics.fresh('bus', lambda status: status.keys['condition'] == 'ok', 'condition ok')


if __name__ == '__main__':
    rospy.init_node('stop_test')
    rostest.rosrun(PACKAGE, 'stop', StopTest)
