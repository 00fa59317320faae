"""All names of the package's simulated boards, the far ends of the judge's lines."""
from typing import Any, Callable, Optional

# pylint: disable=unused-import
from serial_communication.boards.arduino.simulator import ModelCar  # noqa: F401
from serial_communication.boards.bus.simulator import ControlBoard as BusBoard
from serial_communication.boards.mcu.simulator import SensorBoard  # noqa: F401
from serial_communication.simulation.announcing import write_announcement  # noqa: F401
from serial_communication.simulation.faults import Faults, parse
from serial_communication.simulation.line import SimulatedLine


class ControlBoard(BusBoard):
    """Replies with the values of the request, so that a reply tells whose it is."""

    def _custom_function(self, function: Any, request: Any, now: float) -> Any:
        reply = super()._custom_function(function, request, now)
        return reply._replace(data=request.data) if reply.data else reply


def line_of(board: Any, write: Callable[[bytes], None], note: Callable[[float, str, dict], None],
            drift: Optional[float]) -> SimulatedLine:
    """The board's end of a line; `drift`, ppm: the board sends its time."""
    return SimulatedLine(board, write, Faults(parse(
        '' if drift is None else f'drift={drift}', board)), note)
