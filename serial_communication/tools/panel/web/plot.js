/**
 * A moving plot of the last seconds of some fields; the latest sample is at the right edge. A click or
 * the space bar pauses it; pointing at it or the arrow keys show the values at a time; the keys + and −,
 * and the wheel once it has the focus, zoom.
 */
import {colour, context, formatNumber, h, updateAttribute, updateText} from './dom.js';

const SPANS = [5, 10, 20, 60, 300, 600];     // s that may be shown
const LEAST_SPAN = 2;     // of these, the shortest that is shown at first
const SAMPLES = 100;      // that are shown at first, at least
const STEP = 0.02;        // of the width, by an arrow key
const HELP = 'click or space: pause; arrow keys: values; + and −: zoom';
const DESCRIBED = 5;      // s between two descriptions for screen readers
const EDGE = 6;           // px above and below the curves
const GREATEST = 1e300;   // the difference of two larger numbers may be infinite
const FINEST = 1e-12;     // least height relative to the values, which doubles can still resolve

export class Plot {
  /**
   * @param curves [{topic, field, colour, name}]; a colour is a variable of the style sheet
   * @param span s that are shown at first; null: by the rate of the first topic
   * @param least smallest difference between the limits, so that noise looks small
   */
  constructor(title, curves, {span = null, least = 1, digits = 1, high = 120} = {}) {
    Object.assign(this, {_title: title, _curves: curves, _span: span, _least: least,
      _digits: digits, _described: -Infinity, _low: null, _high: null, _cursor: null, _pausedAt: null});
    this._canvas = h('canvas', {class: 'plot', role: 'img', tabindex: '0', 'aria-label': title, title: HELP,
      onclick: () => this._pause(), onkeydown: (event) => this._key(event),
      onpointermove: (event) => { this._cursor = event.offsetX / this._canvas.clientWidth; },
      onpointerleave: () => { this._cursor = null; },
      onwheel: (event) => {
        if (document.activeElement !== this._canvas) return;
        event.preventDefault();
        this._zoom(Math.sign(event.deltaY));
      }});
    this._note = h('span', {class: 'span', role: 'status'});
    this._canvas.style.height = `${high}px`;
    const keys = curves.length > 1 ? curves.map((curve) => {
      const key = h('span', {class: 'key'}, curve.name);
      key.style.setProperty('--key', `var(${curve.colour})`);
      return key;
    }) : [];
    this.element = h('figure', {class: 'figure'},
      h('figcaption', {}, h('span', {}, title), ...keys, this._note), this._canvas);
  }

  draw(model, latest) {
    const area = context(this._canvas);
    if (!area) return;
    this._span ??= spanOf(model.topic(this._curves[0].topic));
    if (!this._span) return;
    this._now = latest;
    const now = this._pausedAt ?? latest, from = now - this._span;
    const series = this._curves.map((curve) => {
      const topic = model.topic(curve.topic), field = topic.field(curve.field);
      return {curve, topic, at: field?.at, first: lowerBound(topic.samples, from),
        end: this._pausedAt === null ? topic.samples.length : lowerBound(topic.samples, now)};
    }).filter((each) => each.at !== undefined);
    const [low, high] = this._limits(series);
    this._frame(area, low, high);
    const x = (time) => (time - from) / this._span * area.width;
    const y = (value) => EDGE + (high - value) / (high - low) * (area.height - 2 * EDGE);
    for (const each of series) this._trace(area.ctx, each, x, y);
    updateText(this._note, this._words(series, from));
    if (this._cursor !== null) {
      area.ctx.fillStyle = colour('--text');
      area.ctx.fillRect(Math.round(this._cursor * area.width), 0, 1, area.height);
    }
    this._describe(now, low, high, series);
  }

  /** The span, and the values at the cursor. */
  _words(series, from) {
    const span = this._span >= 120 ? `${this._span / 60} min` : `${this._span} s`;
    const paused = this._pausedAt === null ? '' : 'paused, ';
    if (this._cursor === null) return paused + span;
    const at = from + this._cursor * this._span;
    const values = series.map(({curve, topic, at: column}) => {
      const sample = topic.samples[lowerBound(topic.samples, at)] ?? topic.last;
      return `${series.length > 1 ? curve.name + ' ' : ''}${formatNumber(sample?.[column], this._digits)}`;
    });
    return `${paused}${(this._now - at).toFixed(1)} s ago: ${values.join(', ')}`;
  }

  _pause() { this._pausedAt = this._pausedAt === null ? this._now : null; }

  /** Show a longer (1) or a shorter (-1) span. */
  _zoom(direction) {
    const at = SPANS.indexOf(this._span) + direction;
    if (SPANS[at]) this._span = SPANS[at];
  }

  _key(event) {
    const move = {ArrowLeft: -STEP, ArrowRight: STEP}[event.key];
    if (move) this._cursor = Math.min(1, Math.max(0, (this._cursor ?? 1) + move));
    else if (event.key === ' ') this._pause();
    else if (event.key === '+' || event.key === '-') this._zoom(event.key === '+' ? -1 : 1);
    else if (event.key === 'Escape') this._cursor = this._pausedAt = null;
    else return;
    event.preventDefault();
  }

  /** The limits grow at once and shrink slowly, so that the plot does not jump. */
  _limits(series) {
    let low = Infinity, high = -Infinity;
    for (const {topic, at, first, end} of series) {
      for (let index = first; index < end; index++) {
        const value = Number(topic.samples[index][at]);
        if (value < low && value >= -GREATEST) low = value;
        if (value > high && value <= GREATEST) high = value;
      }
    }
    if (low > high) [low, high] = [0, this._least];
    const middle = (low + high) / 2;
    const half = Math.max(high - low, this._least, Math.abs(middle) * FINEST) / 2 * 1.12;
    const want = [middle - half, middle + half];
    if (this._low === null || want[0] < this._low || want[1] > this._high) {
      this._low = Math.min(this._low ?? want[0], want[0]);
      this._high = Math.max(this._high ?? want[1], want[1]);
    }
    this._low += (want[0] - this._low) * 0.03;
    this._high += (want[1] - this._high) * 0.03;
    return [Math.min(this._low, want[0]), Math.max(this._high, want[1])];
  }

  _frame({ctx, width, height}, low, high) {
    ctx.font = '11px system-ui, sans-serif';
    ctx.lineWidth = 1;
    const step = niceStep((high - low) / (height / 30));
    for (let count = Math.ceil(low / step); count * step <= high; count++) {
      const value = count * step;
      const y = Math.round(EDGE + (high - value) / (high - low) * (height - 2 * EDGE)) + 0.5;
      const zero = Math.abs(value) < step / 2;
      ctx.strokeStyle = colour(zero ? '--axis' : '--grid');
      ctx.beginPath();
      ctx.moveTo(0, y);
      ctx.lineTo(width, y);
      ctx.stroke();
      ctx.fillStyle = colour('--faint');
      if (y > 10) ctx.fillText(formatNumber(value, Math.max(0, -Math.floor(Math.log10(step)))), 2, y - 3);
    }
  }

  /** Draw one curve: in each column of pixels, the least and the greatest sample. */
  _trace(ctx, {curve, topic, at, first, end}, x, y) {
    const gap = topic.limit ?? Infinity;
    ctx.strokeStyle = colour(curve.colour);
    ctx.lineWidth = 1.5;
    ctx.lineJoin = 'round';
    ctx.beginPath();
    let column = null, low = 0, high = 0, before = -Infinity, alone = false;
    const flush = () => {
      if (column === null) return;
      ctx.lineTo(column, y(low));
      if (high !== low) ctx.lineTo(column, y(high));
      else if (alone) ctx.lineTo(column + 1, y(low));
    };
    for (let index = Math.max(0, first - 1); index < end; index++) {
      const sample = topic.samples[index], value = Number(sample[at]);
      if (!(Math.abs(value) <= GREATEST)) { flush(); column = null; before = -Infinity; continue; }
      const px = Math.round(x(sample[0]));
      if (sample[0] - before > gap || column === null) {
        flush();
        ctx.moveTo(px, y(value));
        [column, low, high, alone] = [px, value, value, true];
      } else if (px === column) {
        low = Math.min(low, value);
        high = Math.max(high, value);
      } else {
        flush();
        [column, low, high, alone] = [px, value, value, false];
      }
      before = sample[0];
    }
    flush();
    ctx.stroke();
  }

  _describe(now, low, high, series) {
    if (now - this._described < DESCRIBED) return;
    this._described = now;
    const latest = series.map(({curve, topic, at}) =>
      `${curve.name ?? curve.field} ${formatNumber(topic.last?.[at], this._digits)}`).join(', ');
    updateAttribute(this._canvas, 'aria-label', `${this._title}, the last ${this._span} seconds: between `
      + `${formatNumber(low, this._digits)} and ${formatNumber(high, this._digits)}; now ${latest}`);
  }
}

/** The span that shows enough samples of a topic; null while nothing of it is known. */
function spanOf(topic) {
  if (!topic.last) return null;
  const wanted = topic.limit === null ? Infinity : topic.limit / 3 * SAMPLES;    // limit: three periods
  return SPANS.slice(LEAST_SPAN).find((span) => span >= wanted) ?? SPANS[SPANS.length - 1];
}

/** The index of the first sample that is not before this time. */
export function lowerBound(samples, time) {
  let low = 0, high = samples.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (samples[middle][0] < time) low = middle + 1;
    else high = middle;
  }
  return low;
}

/** The smallest of 1, 2 or 5 times a power of ten that is at least this. */
function niceStep(least) {
  const power = 10 ** Math.floor(Math.log10(least));
  return power * [1, 2, 5, 10].find((each) => each * power >= least);
}
