/**
 * The connection to the panel (session.py says what is said over it). It comes back by itself,
 * and it knows what time it is there: `now` runs on while nothing comes, so that ages are true
 * also of what the network has delayed.
 */
const SILENCE = 1.0;       // s without an update, which comes 25 times a second: it is gone
const GIVE_UP = 4.0;       // s after which another connection is tried
const AGAIN = [0.3, 2.0];  // s from one try to the next: first, last
const HIDDEN = 60.0;       // s that a hidden tab stays connected
const DRIFT = 0.0005;      // s a second that the two clocks may run apart

const seconds = () => performance.now() / 1000;

export class Connection extends EventTarget {
  constructor() {
    super();
    this.seen = 0;             // `now` of the latest update
    this.words = 'connecting …';
    this._offset = Infinity;   // our clock less theirs, the network's least delay included
    this._heard = -Infinity;
    this._again = AGAIN[0];
    this._due = 0;
    this._hiddenAt = null;
    this._watch = [];
    document.addEventListener('visibilitychange', () => this._visibility());
    this._open();
    setInterval(() => this._check(), 100);
  }

  /** The panel's clock. */
  now() { return this.alive || this._offset !== Infinity ? seconds() - this._offset : 0; }

  /** Whether it speaks. */
  get alive() { return this.silence() < SILENCE; }

  /** Seconds since it last spoke. */
  silence() { return seconds() - this._heard; }

  /** Say something, and what had been seen by then; whether it could be said. */
  send(what) {
    if (this._socket?.readyState !== WebSocket.OPEN) return false;
    this._socket.send(JSON.stringify({seen: this.seen, ...what}));
    return true;
  }

  /** These topics are shown. */
  watch(topics) {
    this._watch = [...topics];
    this.send({watch: this._watch});
  }

  _open() {
    const socket = new WebSocket(`${location.protocol.replace('http', 'ws')}//${location.host}/socket`);
    this._socket = socket;
    this._due = seconds() + GIVE_UP;
    socket.onopen = () => this.send({watch: this._watch});
    socket.onmessage = (event) => {
      if (socket === this._socket) this._take(JSON.parse(event.data));
    };
    socket.onclose = (event) => {
      if (socket === this._socket) this._closed(event.reason);
    };
  }

  _take(update) {
    const at = seconds();
    if (update.now < this.seen) this._offset = Infinity;   // the machine has been started anew
    this._offset = Math.min(this._offset + DRIFT * Math.min(at - this._heard, 1), at - update.now);
    this._heard = at;
    this._again = AGAIN[0];
    this.seen = update.now;
    this.send({});
    this.dispatchEvent(new CustomEvent('update', {detail: update}));
  }

  _closed(reason) {
    this._socket = null;
    this._heard = -Infinity;
    if (this._hiddenAt !== null) return;
    this.words = reason || this.words;
    this._due = seconds() + this._again;
    this._again = Math.min(this._again * 1.6, AGAIN[1]);
    this.dispatchEvent(new Event('lost'));
    this._ask();
  }

  /** A WebSocket does not say why it was refused: ask for a file. */
  async _ask() {
    try {
      const answer = await fetch('icon.svg', {cache: 'no-store'});
      this.words = answer.ok ? 'the panel refuses another page: too many look already'
        : (await answer.text()).split('\n').filter((line) => line).join(' ');
    } catch {
      this.words = 'the panel does not answer';
    }
  }

  _check() {
    if (this._hiddenAt !== null && seconds() - this._hiddenAt > HIDDEN) {
      this._socket?.close();
      return;
    }
    if (this._socket && seconds() - Math.max(this._heard, this._due - GIVE_UP) > GIVE_UP) {
      const socket = this._socket;
      this._closed('');
      socket.close();
    }
    if (!this._socket && seconds() > this._due) this._open();
  }

  _visibility() {
    this._hiddenAt = document.hidden ? seconds() : null;
    if (!document.hidden && !this._socket) this._open();
  }
}
