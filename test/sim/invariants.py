"""What the bridge promises, as functions on what happened to one link.

Each has the promise as its docstring, and yields (tries, what broke it): how often the promise was
at stake, and one text for each time that it was broken.
"""
from typing import Callable, Iterator, Tuple

import promises_bus as bus
import promises_car as car
import promises_data as data
import promises_doubt as doubt
import promises_link as link
from evidence import Evidence
from promises import Verdicts

Invariants = Tuple[Callable[[Evidence], Verdicts], ...]

OF_THE_CAR: Invariants = (
    car.heartbeats_in_time, car.speed_0_first, car.speeds_are_commanded,
    car.no_old_speed_arrives, car.speed_times_out, car.stops_are_repeated,
    car.a_stall_ends_with_speed_0, car.a_calibrating_board_is_left_alone,
    car.stale_commands_are_refused, car.announced_rows_wait, car.commands_arrive_unchanged,
    car.commands_arrive, car.refusals_are_true, car.calibrations_end,
    car.silences_were_observed, car.heartbeats_are_regular, car.the_end_is_speed_0,
    car.no_stop_without_a_cause, car.dropped_output_ends_with_speed_0,
    car.motions_are_commanded, car.calibrations_end_in_time,
    doubt.a_silent_pty_takes_no_command, doubt.standing_output_takes_no_command,
    doubt.motions_begin_with_zero, doubt.motions_stop, doubt.motions_end_first,
    doubt.motions_are_saturated, doubt.zeros_need_not_be_fresh)
OF_ALL: Invariants = (
    car.nothing_moves_while_stopped, car.nothing_follows_a_loan, data.values_are_of_frames,
    data.no_stale_value, data.frames_are_published, data.stamps_are_of_the_read,
    data.stamps_are_of_the_measurement, data.settings_are_in_use, data.settings_are_sent,
    data.settings_leave_room, data.the_port_is_opened_again, link.sent_frames_are_tapped,
    link.received_frames_are_tapped, link.bytes_are_counted, link.frames_are_counted,
    link.errors_are_counted, link.damage_is_counted, link.lost_frames_are_counted,
    link.stale_bytes_are_counted, link.conditions_are_true, link.a_loan_is_told,
    link.a_silent_network_is_opened_again,
    link.reconnects_are_counted, link.settings_of_the_port_are_restored, link.loans_are_fresh,
    link.announced_rows_are_in_use, link.wanted_settings_return,
    car.settings_wait_for_their_board, car.values_are_of_this_board,
    doubt.a_port_closes_for_a_cause, doubt.a_stalled_network_is_opened_again,
    doubt.a_stall_drops_the_output,
    doubt.the_log_is_sparing, doubt.rows_outlive_doubts, doubt.a_doubt_is_told,
    doubt.short_stalls_lose_nothing, doubt.standing_output_is_dropped,
    doubt.a_silent_pty_is_doubted, link.damage_does_not_bend_the_line)
OF_THE_SENSORS: Invariants = (data.silence_is_reported,)
OF_THE_BUS: Invariants = (
    bus.calls_are_told_the_truth, bus.calls_return, bus.a_sync_comes_first,
    bus.fences_precede_calls, bus.stops_are_sent_at_once, bus.stale_calls_are_refused,
    bus.moves_are_not_late, bus.one_request_is_outstanding,
    bus.replies_are_used_for_their_request, bus.readings_are_of_the_environment,
    bus.moves_are_repeated_only_after_invalid, bus.readings_are_repeated,
    bus.silence_is_a_fence, bus.calls_go_before_polls, bus.polls_go_on, bus.a_stop_is_repeated,
    bus.unheard_moves_are_not_late, bus.functions_are_announced,
    bus.a_lost_synchronisation_is_restored, bus.refusals_are_confirmed,
    bus.calls_end_with_their_port, bus.a_board_without_echo_gets_no_call,
    bus.polls_do_not_pile_up, bus.calls_are_in_order, bus.calls_are_not_given_up,
    bus.a_stop_ends_what_waits,
    bus.refused_calls_are_repeated, bus.a_loan_waits_for_no_move, doubt.a_doubt_is_fenced,
    doubt.an_unheard_move_is_a_doubt)
ALL: Invariants = OF_THE_CAR + OF_ALL + OF_THE_SENSORS + OF_THE_BUS
_OF = {'arduino': OF_THE_CAR, 'mcu': OF_THE_SENSORS, 'bus': OF_THE_BUS}


def judge(evidence: Evidence) -> Iterator[Tuple[str, int, str]]:
    """All verdicts on one link: the invariant's name, tries, and what broke it."""
    for invariant in OF_ALL + _OF[evidence.kind]:
        for tries, broken in invariant(evidence):
            yield invariant.__name__, tries, broken
