/** What the page knows of the bridge: everything that `update` has told so far. */
const KEPT = 600;          // s of rows
const MOST_ROWS = 4000;    // of one topic: 40 s of what comes a hundred times a second
const MOST_CALLS = 30;     // whose answers stay to be read
const ERRORS_SHOWN = 10;   // s that an error keeps its link from looking well

/** One topic: its values' names, and rows of [time, value …]. */
class Topic {
  constructor(name) {
    this.name = name;
    this.fields = [];
    this.rows = [];
    this.words = '';
    this.limit = null;
    this.fresh = false;      // rows have come since the last drawing
  }

  take({rows, words, limit, fields}) {
    if (fields) {
      const names = (shape) => shape.map(([name]) => name).join();
      if (this.rows.length && names(fields) !== names(this._shape ?? [])) this.rows = [];
      this._shape = fields;
      this.fields = fields.map(([name, unit, digits, low, high], at) =>
        ({name, unit, digits, low, high, at: at + 1}));
    }
    const last = this.rows.length ? this.rows[this.rows.length - 1][0] : -Infinity;
    for (const row of rows) {
      if (row[0] > last) this.rows.push(row.map((each) =>
        each === 'NaN' ? NaN : each === 'Infinity' ? Infinity : each === '-Infinity' ? -Infinity : each));
    }
    if (this.rows.length > MOST_ROWS * 1.1) this.rows.splice(0, this.rows.length - MOST_ROWS);
    this.words = words;
    this.limit = limit;
    this.fresh = true;
  }

  forgetBefore(time) {
    if (this.rows.length > 1 && this.rows[0][0] < time) {
      this.rows.splice(0, this.rows.findIndex((row) => row[0] >= time));
    }
  }

  field(name) { return this.fields.find((each) => each.name === name); }

  /** The latest row. */
  get last() { return this.rows[this.rows.length - 1]; }

  /** The latest value of a field; undefined while there is none. */
  value(name) {
    const field = this.field(name);
    return field && this.last?.[field.at];
  }

  age(now) { return this.last ? Math.max(0, now - this.last[0]) : Infinity; }

  stale(now) { return this.limit !== null && this.age(now) > this.limit; }
}

/** One link, as /diagnostics tells of it. */
class Link {
  constructor(name) {
    this.name = name;
    this.at = null;
    this.level = null;
    this.summary = '';
    this.values = {};
    this.errors = [];        // rows of [time, Map of counts by cause]
    this._counted = [];      // [time, frames received, frames sent]
  }

  take({at, level, summary, values, errors}) {
    if (at === null) return;
    Object.assign(this, {at, level, summary, values});
    const last = this.errors.length ? this.errors[this.errors.length - 1][0] : -Infinity;
    for (const [time, counts] of errors) {
      if (time > last) this.errors.push([time, new Map(Object.entries(counts))]);
    }
    this.errors = this.errors.filter((row) => at - row[0] <= KEPT);
    this._counted.push([at, Number(values['frames received']), Number(values['frames sent'])]);
    if (this._counted.length > 4) this._counted.shift();
  }

  /** Frames a second, in or out; null while that is not known. */
  rate(sent) {
    const first = this._counted[0], last = this._counted[this._counted.length - 1];
    const column = sent ? 2 : 1;
    if (!first || last[0] - first[0] < 0.5 || last[column] < first[column]) return null;
    return (last[column] - first[column]) / (last[0] - first[0]);
  }

  /** How often what went wrong since then: a Map by cause. A cause may have any name. */
  errorsSince(time) {
    const sums = new Map();
    for (const [at, counts] of this.errors) {
      if (at <= time) continue;
      for (const [cause, count] of counts) sums.set(cause, (sums.get(cause) ?? 0) + count);
    }
    return sums;
  }

  stale(now) { return this.at === null || now - this.at > 3; }

  /** none, ok, warn or error: what the card looks like. */
  look(now) {
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
    this.drive = {held: false, words: ''};
    this.controls = null;
  }

  topic(name) {
    if (!this.topics.has(name)) this.topics.set(name, new Topic(name));
    return this.topics.get(name);
  }

  take(update) {
    if (this._now > update.now) {        // the machine has been started anew
      this.topics.clear();
      this.links.clear();
    }
    if ('node' in update) {              // the first of a connection: it says all there is
      this.log = [];
      this.calls.clear();
      this.links.clear();
      this.controls = update.controls ?? null;
    }
    this._now = update.now;
    for (const key of ['node', 'trouble', 'known', 'boards', 'drive', 'controls']) {
      if (key in update) this[key] = update[key];
    }
    for (const [name, told] of Object.entries(update.topics ?? {})) {
      this.topic(name).take(told);
      this.topic(name).forgetBefore(update.now - KEPT);
    }
    for (const [name, told] of Object.entries(update.links ?? {})) {
      if (!this.links.has(name)) this.links.set(name, new Link(name));
      this.links.get(name).take(told);
    }
    this.log.push(...update.log ?? []);
    this.log.splice(0, this.log.length - 100);
    for (const call of update.calls ?? []) this.calls.set(call.number, call);
    for (const number of this.calls.keys()) {
      if (this.calls.size > MOST_CALLS) this.calls.delete(number);    // the oldest
    }
  }
}
