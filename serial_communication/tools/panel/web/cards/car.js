/** The car in 3D, by its attitude and steering; hidden where the bridge has no car. */
import {drawCar} from '../car3d.js';
import {card, h, setAttribute} from '../dom.js';

const IMU = '~imu', STEERING = '~steering_angle';
const FULL = 1024, MOST = 0.5;      // of the feedback of the servo; rad of the front wheels

export class Car {
  constructor() {
    this._canvas = h('canvas', {class: 'car3d', role: 'img', 'aria-label': 'attitude of the car'});
    this.element = card('Car', `${IMU}, ${STEERING}`, this._canvas);
    this.element.hidden = true;
    this._drawn = '';
  }

  draw(model, now) {
    const imu = model.topics.get(IMU), steering = model.topics.get(STEERING);
    const angles = ['roll', 'pitch', 'yaw'].map((name) => imu?.value(name));
    this.element.hidden = !steering || !angles.every(Number.isFinite);
    if (this.element.hidden) return;
    setAttribute(this._canvas, 'data-state', imu.state(now));
    // More feedback is to the right.
    const steer = (1 - 2 * (steering.value('value') ?? FULL / 2) / FULL) * MOST;
    const shape = JSON.stringify([...angles.map(Math.round), steer.toFixed(2),
      this._canvas.clientWidth]);
    if (shape === this._drawn) return;
    this._drawn = shape;
    const [roll, pitch, yaw] = angles.map((each) => each * Math.PI / 180);
    drawCar(this._canvas, {roll, pitch, yaw}, steer);
  }
}
