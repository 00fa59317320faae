/** What the page knows of the bridge: the sum of all updates. */
const KEPT = 600;          // s of samples and errors
const MAX_SAMPLES = 4000;  // of one topic: 40 s at 100 Hz
const MAX_CALLS = 30;      // whose answers are kept
const ERRORS_SHOWN = 10;   // s for which an error marks its link
const STATUS_PERIOD = 1;   // s between two statuses of a link

/** One topic: its fields, and samples of [time, value …]. */
class TopicData {
  constructor(name) {
    this.name = name;
    this.fields = [];
    this.samples = [];
    this.words = '';
    this.limit = null;
  }

  take({samples, words, limit, fields}) {
    if (fields) {
      const names = (shape) => shape.map(([name]) => name).join();
      if (this.samples.length && names(fields) !== names(this._shape ?? [])) this.samples = [];
      this._shape = fields;
      this.fields = fields.map(([name, unit, digits, low, high], at) =>
        ({name, unit, digits, low, high, at: at + 1}));
    }
    const last = this.samples.length ? this.samples[this.samples.length - 1][0] : -Infinity;
    for (const sample of samples) {
      if (sample[0] > last) this.samples.push(sample.map((each) =>
        each === 'NaN' ? NaN : each === 'Infinity' ? Infinity : each === '-Infinity' ? -Infinity : each));
    }
    if (this.samples.length > MAX_SAMPLES * 1.1) this.samples.splice(0, this.samples.length - MAX_SAMPLES);
    this.words = words;
    this.limit = limit;
  }

  forgetBefore(time) {
    if (this.samples.length > 1 && this.samples[0][0] < time) {
      this.samples.splice(0, this.samples.findIndex((sample) => sample[0] >= time));
    }
  }

  field(name) { return this.fields.find((each) => each.name === name); }

  /** The latest sample; undefined if there is none. */
  get last() { return this.samples[this.samples.length - 1]; }

  /** The latest value of a field; undefined if there is none. */
  value(name) {
    const field = this.field(name);
    return field && this.last?.[field.at];
  }

  age(now) { return this.last ? Math.max(0, now - this.last[0]) : Infinity; }

  stale(now) { return this.limit !== null && this.age(now) > this.limit; }
}

/** One link, as /diagnostics reports it. */
class LinkStatus {
  constructor(name) {
    this.name = name;
    this.at = null;
    this.level = null;
    this.summary = '';
    this.values = {};
    this.errors = [];        // entries of [time, Map of counts by cause]
    this._counted = [];      // [time, frames received, frames sent]
  }

  take({at, level, summary, values, errors}) {
    if (at === null) return;
    Object.assign(this, {at, level, summary, values});
    const last = this.errors.length ? this.errors[this.errors.length - 1][0] : -Infinity;
    for (const [time, counts] of errors) {
      if (time > last) this.errors.push([time, new Map(Object.entries(counts))]);
    }
    this.errors = this.errors.filter(([time]) => at - time <= KEPT);
    this._counted.push([at, Number(values['frames received']), Number(values['frames sent'])]);
    if (this._counted.length > 4) this._counted.shift();
  }

  /** Frames per second, sent or received; null if not known. */
  rate(sent) {
    const first = this._counted[0], last = this._counted[this._counted.length - 1];
    const column = sent ? 2 : 1;
    if (!first || last[0] - first[0] < 0.5 || last[column] < first[column]) return null;
    return (last[column] - first[column]) / (last[0] - first[0]);
  }

  /** Errors since then: a Map from cause to count. A cause may have any name. */
  errorsSince(time) {
    const sums = new Map();
    for (const [at, counts] of this.errors) {
      if (at <= time) continue;
      for (const [cause, count] of counts) sums.set(cause, (sums.get(cause) ?? 0) + count);
    }
    return sums;
  }

  stale(now) { return this.at === null || now - this.at > 3; }

  /** none (no status), ok, warn or error. */
  health(now) {
    if (this.stale(now)) return 'none';
    if (this.level >= 2) return 'error';
    const errors = [...this.errorsSince(now - ERRORS_SHOWN).values()].some((count) => count);
    return this.level === 1 || errors ? 'warn' : 'ok';
  }
}

export class Model {
  constructor() {
    this.node = '';
    this.trouble = '';
    this.known = {};
    this.boards = {};         // by link
    this.topics = new Map();
    this.links = new Map();
    this.log = [];
    this.calls = new Map();   // number -> call
    this.drives = false;      // a page
    this.controls = null;
  }

  topic(name) {
    if (!this.topics.has(name)) this.topics.set(name, new TopicData(name));
    return this.topics.get(name);
  }

  /** Whether STOP holds: by /diagnostics, unless ~stop was answered less than a status before. */
  stopped(now) {
    const links = [...this.links.values()].filter((link) => !link.stale(now));
    let at = Math.max(...links.map((link) => link.at));
    let held = links.some((link) => link.values.condition === 'stopped');
    for (const {name, outcome, began, took, arguments: {data}} of this.calls.values()) {
      const until = began + took + STATUS_PERIOD;
      if (name === '~stop' && outcome === 'done' && until > at) [at, held] = [until, data];
    }
    return links.length > 0 && held;
  }

  take(update) {
    if (this._now > update.now) {        // the panel's machine has been restarted
      this.topics.clear();
      this.links.clear();
    }
    if ('node' in update) {              // the first update of a connection has the whole state
      this.log = [];
      this.calls.clear();
      this.links.clear();
      this.controls = update.controls ?? null;
    }
    this._now = update.now;
    for (const key of ['node', 'trouble', 'known', 'boards', 'drives', 'controls']) {
      if (key in update) this[key] = update[key];
    }
    for (const [name, changes] of Object.entries(update.topics ?? {})) {
      this.topic(name).take(changes);
      this.topic(name).forgetBefore(update.now - KEPT);
    }
    for (const [name, changes] of Object.entries(update.links ?? {})) {
      if (!this.links.has(name)) this.links.set(name, new LinkStatus(name));
      this.links.get(name).take(changes);
    }
    this.log.push(...update.log ?? []);
    this.log.splice(0, this.log.length - 100);
    for (const call of update.calls ?? []) this.calls.set(call.number, call);
    for (const number of this.calls.keys()) {
      if (this.calls.size > MAX_CALLS) this.calls.delete(number);    // the oldest
    }
  }
}
