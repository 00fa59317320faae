"""What each byte of a frame means, valid or not, for programs that show frames to people.

A frame is a header, data and an end. All have layouts: those of the data are the messages' own.
"""
from functools import reduce
from operator import xor
from typing import Any, Dict, List, Mapping, NamedTuple, Optional

from ...boards.arduino import wire as arduino
from ...boards.bus import wire as bus
from ...boards.mcu import wire as mcu
from ...framing.layout import Layout, Value
from ...framing.stream import FRAMING, SETTING, Frame, StreamDecoder
from . import lines

NOT_KNOWN = 'not known here'       # the meaning of a number that has none


class Part(NamedTuple):
    """Adjacent bytes of a frame that have one name.

    The parts of a frame are in order, have no gaps, and together are all of its bytes.
    """

    start: int             # its bytes are frame[start:end]
    end: int
    name: str              # as the protocol has it, or the name of a value
    data: bytes            # those bytes, decoded if the wire has them encoded
    raw: Any = None        # the number or text in them; None: just bytes
    value: Any = None      # that number scaled and converted, in `unit`
    unit: str = ''
    meaning: str = ''      # more about it, in words
    error: str = ''        # what is wrong; '': nothing
    missing: int = 0       # how many of its bytes are missing; `error` says so, too


class _Format(NamedTuple):
    """The fields of a frame around its data."""

    data: str               # name of data without a layout
    header: Layout          # its second value is a length
    end: Layout             # its first value is the XOR of all before it, from `checked` on
    beside: int = 0         # bytes that the length counts besides the data
    checked: int = 0


def _bus_format(is_long: bool, has_cmd2: bool) -> _Format:
    values = [Value('Flag'), Value('Datelen', 'bytes of DATE', minimum=255 if is_long else 0,
                                   maximum=bus.MAX_LENGTH if is_long else 254),
              Value('CMD1'), Value('CMD2')][:3 + has_cmd2]
    header = Layout(('<BHBB' if is_long else '<BBBB')[:4 + has_cmd2], values)
    return _Format('DATE', header, Layout('<B', [Value('Checksum')]))


_FLAGS = {bus.STANDARD_FLAG: 'standard frame', bus.LONG_FLAG: 'long frame'}
_ERROR_CODES = {size: Layout(code, [Value('error code')]) for size, code in ((1, '<B'), (2, '<H'))}
_MCU = _Format('PAYLOAD', Layout('<BBBB', [
    Value('STX'), Value('LEN', 'bytes of TYPE, SEQ and PAYLOAD', minimum=mcu.MIN_LEN),
    Value('TYPE'), Value('SEQ')]), Layout('<BB', [
        Value('CRC'), Value('ETX', minimum=mcu.ETX, maximum=mcu.ETX)]), mcu.MIN_LEN, 2)
_ARDUINO = Layout('<B', [Value('type')])


class Explainer:
    """Finds the parts of frames in one direction of a line; RowError as `Description.decoder`."""

    def __init__(self, line: lines.Settings, sent: bool) -> None:
        self.decoder: Any = line.decoder(sent)
        self._sent = sent
        self._has_cmd2 = sent or bool(line.parameters.get('reply_has_cmd2'))
        self._functions: Dict[Any, Any] = {}       # of the bus
        if isinstance(self.decoder, (bus.RequestDecoder, bus.ReplyDecoder)):
            rows = line.board.read_all(line.parameters)
            self._functions = {**bus.BUILT_IN, **{(row.cmd1, row.number): row for row in rows}}

    def parts(self, raw: bytes, request: Any = None) -> List[Part]:
        """Return the parts of one frame, valid or not, incomplete, or of noise. On the bus the
        `request` that it answers, if known, says what the DATE means."""
        decoder, frames = self.decoder, self.decode(raw)
        if not frames or isinstance(decoder, StreamDecoder) and raw[0] not in decoder.STARTS:
            return _Parts(raw).take_rest('noise', 'no frame begins with these bytes')
        if self._functions:
            return self._bus(raw, request)
        if isinstance(decoder, mcu.Decoder):
            layout, words = self._by_type(raw[2:], raw[4:])
            return _framed(raw, _MCU, {'TYPE': words}, layout, frames[0].message)
        if isinstance(decoder, (arduino.Decoder, arduino.BoardDecoder)):
            return self._cobs(raw, frames[0])
        parts, frame = _Parts(raw), frames[0]      # of a board of another package
        parts.take(len(frame.raw), 'frame', '' if frame.cause else frame.text, frame.error)
        return parts.take_rest('more', 'does not belong to the frame')

    def decode(self, data: bytes) -> List[Frame]:
        """The frames and noise in these bytes, of which nothing follows."""
        decoder = self.decoder
        decoder.reset()
        frames: List[Frame] = decoder.feed(data)
        while decoder.pending:
            frames += decoder.give_up()
        return frames

    def _bus(self, raw: bytes, request: Any) -> List[Part]:
        is_long = raw[0] == bus.LONG_FLAG
        form = _bus_format(is_long, self._has_cmd2)
        cmd1, cmd2 = (*raw[2 + is_long:4 + is_long], -1, -1)[:2]
        words = {'Flag': _FLAGS, 'CMD1': bus.REQUEST_NAMES if self._sent else bus.REPLY_NAMES,
                 'error code': bus.ERROR_TEXTS}
        layout = None
        if self._sent and cmd1 == bus.FUNCTION:
            words['CMD2'] = {each.number: each.name for each in self._functions.values()
                             if each.cmd1 == cmd1}
            function = self._functions.get((cmd1, cmd2))
            if function:
                layout, words['direction'] = function.layout, dict(enumerate(function.directions))
            if raw[:5] == bus.encode_request(bus.ENVIRONMENT_REQUEST):
                form = form._replace(beside=2)
                words['Datelen'] = {2: 'an environment request has no DATE'}
        elif cmd1 in (bus.ERROR, bus.INVALID) and not self._sent:
            layout = _ERROR_CODES.get(raw[1])
        elif cmd1 == bus.OK and request and request[:2] in self._functions:
            reply = self._functions[request[:2]].reply
            layout = None if reply.is_empty else reply
        return _framed(raw, form, words, layout)

    def _by_type(self, type_: bytes, data: bytes) -> Any:
        """The layout of these data, and the names of all types; `type_` begins with its type."""
        messages = self.decoder.messages
        kind = messages.get(type_[0]) if type_ else None
        if kind and kind.TYPE == SETTING:
            kind = messages.get(data[:1], kind)
        return (kind and kind.LAYOUT,
                {number: each.LABEL for number, each in messages.items()})

    def _cobs(self, raw: bytes, frame: Frame) -> List[Part]:
        """The parts of a packet. A COBS code that replaces a zero belongs to the value with the
        zero; any other code is a part of its own."""
        at, end = 0, (raw + b'\0').find(b'\0')
        with_zeros = bytearray(raw)
        places: List[int] = []      # the index of each decoded byte
        while at < end:
            code, with_zeros[at] = raw[at], 0
            places += range(at + 1, min(at + code, end))
            at += code
            if code < 255 and at < end:
                places.append(at)
        decoded = bytes(with_zeros[place] for place in places)
        layout, words = self._by_type(decoded, decoded[1:])
        inner, parts = _Parts(decoded, {'type': words}), _Parts(raw)
        if decoded:
            inner.take_data(1, 'type', _ARDUINO)
            inner.take_data(len(decoded) - 1, 'data', layout, frame.message)
        for part in inner.found:
            if part.data and places[part.start] > parts.at:
                parts.take(places[part.start] - parts.at, 'COBS code', 'the packet without zeros')
            behind = places[part.end - 1] + 1 if part.data else parts.at
            parts.found.append(part._replace(start=parts.at, end=behind))
            parts.at = behind
        if end > parts.at:
            parts.take(end - parts.at, 'COBS code')
        parts.take(1, 'end', error=frame.error if frame.cause == FRAMING and end < len(raw) else '')
        return parts.take_rest('noise', 'bytes after the packet')


def _framed(raw: bytes, form: _Format, words: Mapping[str, Mapping[int, str]],
            layout: Optional[Layout], message: Any = None) -> List[Part]:
    """The parts of a frame with these fields, and data of this layout, if that is known."""
    parts = _Parts(raw, words)
    parts.take_data(form.header.size, '', form.header)
    length = parts.found[1]
    if length.error and not length.missing:
        parts.at, parts.found[2:] = length.end, []
        return parts.take_rest('noise', f'bytes after an invalid {length.name}')
    parts.take_data(max((length.value or 0) - form.beside, 0), form.data, layout, message)
    right = reduce(xor, raw[form.checked:parts.at], 0)
    is_known, index = not any(part.missing for part in parts.found), len(parts.found)
    parts.take_data(form.end.size, '', form.end)
    checksum = parts.found[index]
    if is_known and checksum.raw == right:
        parts.found[index] = checksum._replace(meaning='matches')
    elif is_known:
        parts.found[index] = checksum._replace(
            error=(checksum.error and checksum.error + '; ') + f'should be 0x{right:02x}')
    return parts.take_rest('noise', 'bytes after the frame')


class _Parts:
    """Cuts a frame, which may be incomplete, into its parts from one byte on.

    `words` says what numbers mean, by the names of their parts.
    """

    def __init__(self, raw: bytes, words: Mapping[str, Mapping[int, str]] = {},
                 at: int = 0) -> None:
        self.found: List[Part] = []
        self.at = at            # index of the first byte that is in no part yet
        self._raw = raw
        self._words = words

    def take(self, size: int, name: str, meaning: str = '', error: str = '') -> None:
        """Add the next `size` bytes as one part; missing bytes are an error."""
        data = self._raw[self.at:self.at + size]
        missing = size - len(data)
        if missing:
            error = f'missing, {missing} byte{"s" * (missing > 1)}'
        self.found.append(Part(self.at, self.at + len(data), name, data, meaning=meaning,
                               error=error, missing=missing))
        self.at += len(data)

    def take_rest(self, name: str, error: str = '', end: Optional[int] = None) -> List[Part]:
        """Add the bytes that are left, or those before `end`, if any; return all parts."""
        size = len(self._raw[:end]) - self.at
        if size > 0:
            self.take(size, name, error=error)
        return self.found

    def take_data(self, size: int, name: str, layout: Optional[Layout],
                  message: Any = None) -> None:
        """Add the next `size` bytes, or what is left of them: the values of their layout."""
        end = self.at + size
        inner = _Parts(self._raw[:end], self._words, self.at)
        if layout:
            inner._take_values(layout, message)
        if inner.at < end and not any(part.missing for part in inner.found):
            inner.take(end - inner.at, name)
        self.found += inner.found
        self.at = inner.at

    def _take_values(self, layout: Layout, message: Any) -> None:
        """Add all bytes: values, and what is beside them."""
        begin, data = self.at, self._raw[self.at:]
        size = len(data) if layout.fits(len(data)) else layout.size
        names = tuple(value.name for value in layout.values)
        # Such a message may have other numbers than its layout: see SensorStatus.
        own = message if getattr(message, '_fields', None) == names else names
        for raw, given, value in zip(layout.raw((data + bytes(size))[:size]), own, layout.values):
            given = given if isinstance(given, (int, float)) else value.scaled(raw)
            words = self._words.get(value.name)
            self.take_rest('padding', end=begin + value.start)
            self.take((value.end if value.end >= 0 else size) - value.start,
                      value.name or 'left out')
            if not self.found[-1].missing:
                self.found[-1] = self.found[-1]._replace(
                    raw=raw, value=given, unit=value.unit,
                    meaning=words.get(raw, NOT_KNOWN) if words else 'no value' * (given != given),
                    error=value.why_implausible(given, *value.limits)
                    if value.is_limited else '')
        self.take_rest('padding', end=begin + layout.size)
        self.take_rest('surplus', f'{len(data)} bytes of data, not {layout.sizes()}')
