/** The car: its attitude in 3D, its motion and its battery. */
import {card, h, updateAttribute, updateText} from '../dom.js';
import {drawCar} from '../car3d.js';
import {Plot} from '../plot.js';
import {Reading} from '../reading.js';

const IMU = '~imu';
const MIDDLE = 512, TURN = 512;      // of the raw steering angle: its middle, and its range to either side
const WHEEL_ANGLE = 0.5;             // rad of the drawn wheels at the end of that range
const radians = (degrees) => degrees * Math.PI / 180;

export class Attitude {
  constructor() {
    this.topics = [IMU, '~steering_angle', '~imu/calibrating', '~imu/temperature'];
    this._canvas = h('canvas', {class: 'car3d', role: 'img', 'aria-label': 'attitude of the car'});
    this._note = h('p', {class: 'over', hidden: true});
    this._readings = [
      new Reading('roll', IMU, 'roll'), new Reading('pitch', IMU, 'pitch'),
      new Reading('yaw', IMU, 'yaw'), new Reading('IMU', '~imu/temperature', 'temperature')];
    this.element = card('Attitude', '~imu',
      h('div', {class: 'scene'}, this._canvas, this._note),
      h('div', {class: 'readings'}, ...this._readings.map((each) => each.element)));
    this._drawn = '';
  }

  draw(model, now) {
    this._readings.forEach((each) => each.draw(model, now));
    const imu = model.topic(IMU);
    const [roll, pitch, yaw] = ['roll', 'pitch', 'yaw'].map((name) => imu.value(name) ?? 0);
    const steering = model.topic('~steering_angle').value('steering angle') ?? MIDDLE;
    const stale = imu.stale(now) || !imu.last;
    updateAttribute(this._canvas, 'data-state', stale ? 'stale' : 'fresh');
    const calibrating = model.topic('~imu/calibrating').last?.[1] === true;
    this._note.hidden = !calibrating && !stale;
    updateText(this._note, calibrating ? 'the IMU is being calibrated' : 'the attitude is stale');
    drawCar(this._canvas, {roll: radians(roll), pitch: radians(pitch), yaw: radians(yaw)},
      (MIDDLE - steering) / TURN * WHEEL_ANGLE);
    updateAttribute(this._canvas, 'aria-label', `attitude of the car: roll ${roll.toFixed(0)}, pitch `
      + `${pitch.toFixed(0)}, yaw ${yaw.toFixed(0)} degrees`);
  }
}

const AXES = [['x', '--line-1'], ['y', '--line-2'], ['z', '--line-3']];
const axes = (what) => AXES.map(([axis, colour]) =>
  ({topic: IMU, field: `${what} ${axis}`, colour, name: axis}));

export class Motion {
  constructor() {
    this.topics = [IMU, '~ticks', '~steering_angle'];
    this._parts = [];
    const part = (plot, ...readings) => {
      this._parts.push(plot, ...readings);
      return h('div', {class: 'part'}, plot.element,
        h('div', {class: 'readings'}, ...readings.map((each) => each.element)));
    };
    this.element = card('Motion', '~imu, ~ticks, ~steering_angle',
      part(new Plot('acceleration, m/s²', axes('acceleration'), {least: 2, digits: 2}),
        ...AXES.map(([axis]) => new Reading(axis, IMU, `acceleration ${axis}`, {units: ''}))),
      part(new Plot('turning rate, rad/s', axes('rate'), {least: 0.2, digits: 3}),
        ...AXES.map(([axis]) => new Reading(axis, IMU, `rate ${axis}`, {units: ''}))),
      h('div', {class: 'pair'},
        part(new Plot('ticks in 10 ms', [{topic: '~ticks', field: 'ticks', colour: '--line-1'}],
          {least: 4, digits: 0, high: 84}), new Reading('ticks', '~ticks', 'ticks', {units: ''})),
        part(new Plot('steering', [{topic: '~steering_angle', field: 'steering angle',
          colour: '--line-2'}], {least: 64, digits: 0, high: 84}),
        new Reading('of 1024', '~steering_angle', 'steering angle'))));
  }

  draw(model, now) { this._parts.forEach((each) => each.draw(model, now)); }
}

export class Battery {
  constructor() {
    this.topics = ['~voltage'];
    this._reading = new Reading('battery', '~voltage', 'voltage');
    this._plot = new Plot('voltage', [{topic: '~voltage', field: 'voltage', colour: '--line-4'}],
      {least: 0.4, digits: 2, high: 84});
    this.element = card('Battery', '~voltage',
      h('div', {class: 'part beside'}, this._plot.element,
        h('div', {class: 'readings big'}, this._reading.element)));
  }

  draw(model, now) {
    this._reading.draw(model, now);
    this._plot.draw(model, now);
  }
}
