/** The air: smoke, temperature and humidity, each with a plot. */
import {card, h} from '../dom.js';
import {Plot} from '../plot.js';
import {Reading} from '../reading.js';

const AIR = '~environment';
const PARTS = [['smoke', '--line-5', 40, 0], ['temperature', '--line-3', 1, 2],
  ['humidity', '--line-1', 2, 2]];

export class Air {
  constructor() {
    this.topics = [AIR];
    this._parts = PARTS.map(([field, colour, least, digits]) => ({
      reading: new Reading(field, AIR, field),
      plot: new Plot(field, [{topic: AIR, field, colour}], {least, digits, high: 64})}));
    this.element = card('Air', AIR, ...this._parts.map(({reading, plot}) =>
      h('div', {class: 'part beside'}, plot.element,
        h('div', {class: 'readings big'}, reading.element))));
  }

  draw(model, now) {
    for (const {reading, plot} of this._parts) {
      reading.draw(model, now);
      plot.draw(model, now);
    }
  }
}
