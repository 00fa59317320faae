#!/usr/bin/python3
"""LatestWorker, without a ROS master."""
import threading
import unittest

import rosunit

from serial_communication.ros.latest_worker import LatestWorker

PATIENCE = 10.0     # s; only a test that fails waits as long


class LatestWorkerTest(unittest.TestCase):
    """One worker, whose functions write down their calls."""

    def setUp(self):
        self.calls, self.errors = [], []
        self.done = threading.Event()
        self.worker = LatestWorker('worker', 0.0, self.errors.append)

    def first(self, number):
        self.calls.append(('first', number))

    def last(self):
        self.calls.append('last')
        self.done.set()

    def test_of_each_function_only_the_newest_arguments_count(self):
        for number in range(5):
            self.worker.submit(self.first, number)
        self.worker.submit(self.last)
        self.assertEqual(self.calls, [], 'it has not started')
        self.worker.start()
        self.assertTrue(self.done.wait(PATIENCE))
        self.assertEqual(self.calls, [('first', 4), 'last'])

    def test_what_is_submitted_during_a_call_is_called_after_it(self):
        entered, goes_on = threading.Event(), threading.Event()

        def waits(number):
            self.calls.append(number)
            entered.set()
            goes_on.wait(PATIENCE)

        self.worker.start()
        self.worker.submit(waits, 1)
        self.assertTrue(entered.wait(PATIENCE))
        for number in 2, 3:
            self.worker.submit(waits, number)
        self.worker.submit(self.last)
        goes_on.set()
        self.assertTrue(self.done.wait(PATIENCE))
        self.assertEqual(self.calls, [1, 3, 'last'])

    def test_an_error_is_passed_on_and_ends_nothing(self):
        self.worker.start()
        self.worker.submit(lambda: 1 / 0)
        self.worker.submit(self.last)
        self.assertTrue(self.done.wait(PATIENCE))
        self.assertEqual([type(error) for error in self.errors], [ZeroDivisionError])


if __name__ == '__main__':
    rosunit.unitrun('serial_communication', 'latest_worker', '__main__')
