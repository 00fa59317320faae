/** The sensor board: two ranges as bars with their limits, its angles and its ADC channels. */
import {card, formatAge, formatNumber, h, updateAttribute, updateText} from '../dom.js';
import {Reading} from '../reading.js';

const ADC = 'mcu/adc_status';
const FULL = 4095;       // ADC value of a full bar

class Range {
  constructor(name, topic) {
    this._topic = topic;
    this._fill = h('span', {class: 'fill'});
    this._bar = h('div', {class: 'bar', role: 'meter', 'aria-label': name}, this._fill);
    this._low = h('span', {class: 'limit'});
    this._high = h('span', {class: 'limit'});
    this._words = h('span', {class: 'number'}, '–');
    this._age = h('span', {class: 'age'});
    this.element = h('div', {class: 'range', 'data-range': topic},
      h('div', {class: 'range-head'}, h('span', {class: 'label'}, name),
        h('span', {class: 'value'}, this._words), this._age),
      this._bar, h('div', {class: 'limits'}, this._low, this._high));
  }

  draw(model, now) {
    const topic = model.topic(this._topic), field = topic.field('range');
    const value = topic.value('range');
    const stale = topic.stale(now);
    updateAttribute(this.element, 'data-state', !field ? 'none' : stale ? 'stale' : 'fresh');
    updateText(this._age, stale ? `${formatAge(topic.age(now))} old` : '');
    if (!field) return;
    updateText(this._words, topic.words);
    updateText(this._low, `${formatNumber(field.low, 2)} m`);
    updateText(this._high, `${formatNumber(field.high, 2)} m`);
    const part = Number.isNaN(value) ? 0
      : Math.min(1, Math.max(0, (value - field.low) / (field.high - field.low)));
    this._fill.style.width = `${(part * 100).toFixed(1)}%`;
    updateAttribute(this.element, 'data-beyond', Number.isNaN(value) ? 'none' : value === Infinity ? 'far'
      : value === -Infinity ? 'near' : null);
    updateAttribute(this._bar, 'aria-valuemin', field.low);
    updateAttribute(this._bar, 'aria-valuemax', field.high);
    updateAttribute(this._bar, 'aria-valuenow', (field.low + part * (field.high - field.low)).toFixed(3));
    updateAttribute(this._bar, 'aria-valuetext', topic.words);
  }
}

export class Sensors {
  constructor() {
    this.topics = ['mcu/status', 'mcu/range_1', 'mcu/range_2'];
    this._status = h('p', {class: 'words status-line'});
    this._parts = [
      new Range('range 1', 'mcu/range_1'), new Range('range 2', 'mcu/range_2'),
      new Reading('roll', 'mcu/status', 'roll'), new Reading('pitch', 'mcu/status', 'pitch'),
      new Reading('yaw', 'mcu/status', 'yaw')];
    const [one, two, ...angles] = this._parts.map((part) => part.element);
    this.element = card('Ranges', 'mcu/range_1, mcu/range_2', one, two,
      h('div', {class: 'readings'}, ...angles), this._status);
  }

  draw(model, now) {
    this._parts.forEach((part) => part.draw(model, now));
    updateText(this._status, model.topic('mcu/status').words);
  }
}

/** The ADC channels; hidden unless the board has them. */
export class Channels {
  constructor() {
    this.topics = [ADC];
    this._channels = Array.from({length: 6}, (_, channel) => {
      const reading = new Reading(`adc ${channel}`, ADC, `adc${channel}`);
      const fill = h('span', {class: 'fill'});
      return {channel, reading, fill, element: h('div', {class: 'channel'}, reading.element,
        h('div', {class: 'bar', 'aria-hidden': 'true'}, fill))};
    });
    this.element = card('Channels', ADC, ...this._channels.map((each) => each.element));
    this.element.hidden = true;
  }

  draw(model, now) {
    const topic = model.topic(ADC);
    this.element.hidden = !topic.last;
    for (const {channel, reading, fill} of this._channels) {
      reading.draw(model, now);
      const value = topic.value(`adc${channel}`) ?? 0;
      fill.style.width = `${(Math.min(1, value / FULL) * 100).toFixed(1)}%`;
    }
  }
}
