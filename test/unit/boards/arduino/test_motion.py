"""What the judge (test/sim) does not decide of the zero of a motion."""
from serial_communication.boards.arduino.motion import Motion


def test_a_calibration_holds_repetitions_back_and_they_are_not_made_up_for():
    """The board would read them minutes later."""
    motion = Motion(0, 0.5)
    motion.sent(500, 100.0)
    motion.sent(0, 100.0)
    assert not motion.due(100.1, board_reads=False) and motion.due(100.1)
    assert not motion.due(103.0)
