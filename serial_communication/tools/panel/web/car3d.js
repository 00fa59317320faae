/** The car in 3D on a canvas: boxes and wheels, painted from far to near. */
import {colour} from './dom.js';

const EYE = {distance: 6.2, up: 0.45, turn: 0.6};   // of the viewer: up and turn in radians
const LIGHT = [0.35, 0.5, 0.79];
const WHEEL = {radius: 0.36, width: 0.24, corners: 14};

/** The faces of a box. Their corners are in counter-clockwise order, seen from outside. */
function box(x0, x1, y0, y1, z0, z1, paint, taper = 0) {
  const p = (x, y, z) => [z === z1 ? x + (x === x0 ? taper : -taper) : x, y, z];
  const a = p(x0, y0, z0), b = p(x1, y0, z0), c = p(x1, y1, z0), d = p(x0, y1, z0);
  const e = p(x0, y0, z1), f = p(x1, y0, z1), g = p(x1, y1, z1), i = p(x0, y1, z1);
  return [[d, c, b, a], [e, f, g, i], [a, b, f, e], [c, d, i, g], [b, c, g, f], [d, a, e, i]]
    .map((corners) => ({corners, paint}));
}

function wheel(x, y, steer) {
  const half = WHEEL.width / 2, rim = [];
  for (let k = 0; k < WHEEL.corners; k++) {
    const angle = k / WHEEL.corners * 2 * Math.PI;
    rim.push([Math.cos(angle) * WHEEL.radius, Math.sin(angle) * WHEEL.radius]);
  }
  const place = ([u, v], side) => [
    x + u * Math.cos(steer) - side * half * Math.sin(steer),
    y + u * Math.sin(steer) + side * half * Math.cos(steer), v];
  const faces = [
    {corners: rim.map((point) => place(point, -1)), paint: '--wheel-side'},
    {corners: rim.map((point) => place(point, 1)).reverse(), paint: '--wheel-side'}];
  rim.forEach((point, k) => {
    const next = rim[(k + 1) % rim.length];
    faces.push({corners: [place(point, 1), place(next, 1), place(next, -1), place(point, -1)],
      paint: '--wheel'});
  });
  return faces;
}

const BODY = [
  ...box(-1.25, 1.3, -0.55, 0.55, 0.0, 0.34, '--car'),
  ...box(-0.95, 0.55, -0.48, 0.48, 0.34, 0.78, '--car-glass', 0.28),
];

const cross = (a, b) =>
  [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const less = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const unit = (a) => a.map((each) => each / Math.hypot(...a));

/** Rotate from body to world: yaw about z, then pitch about y, then roll about x (REP 103). */
function turned([x, y, z], {roll, pitch, yaw}) {
  [y, z] = [y * Math.cos(roll) - z * Math.sin(roll), y * Math.sin(roll) + z * Math.cos(roll)];
  [x, z] = [x * Math.cos(pitch) + z * Math.sin(pitch), -x * Math.sin(pitch) + z * Math.cos(pitch)];
  return [x * Math.cos(yaw) - y * Math.sin(yaw), x * Math.sin(yaw) + y * Math.cos(yaw), z];
}

/** Draw the car. Angles in radians; `steer` is that of the front wheels, positive to the left. */
export function drawCar(canvas, attitude, steer) {
  const {clientWidth: width, clientHeight: height} = canvas, ratio = window.devicePixelRatio || 1;
  if (!width) return;
  Object.assign(canvas, {width: width * ratio, height: height * ratio});    // this also clears it
  const ctx = canvas.getContext('2d');
  ctx.scale(ratio, ratio);
  const eye = [-Math.cos(EYE.up) * Math.cos(EYE.turn), -Math.cos(EYE.up) * Math.sin(EYE.turn),
    Math.sin(EYE.up)].map((each) => each * EYE.distance);
  const ahead = unit(less([0, 0, 0.1], eye)), right = unit(cross(ahead, [0, 0, 1]));
  const up = cross(right, ahead), scale = Math.min(width * 1.1, height * 1.75);
  const seen = (point) => {
    const from = less(point, eye), depth = dot(from, ahead);
    return [width / 2 + dot(from, right) / depth * scale,
      height / 2 - dot(from, up) / depth * scale, depth];
  };
  ground(ctx, seen);
  const faces = [...BODY, ...wheel(0.85, 0.62, steer), ...wheel(0.85, -0.62, steer),
    ...wheel(-0.8, 0.62, 0), ...wheel(-0.8, -0.62, 0)].map(({corners, paint}) => {
    const world = corners.map((each) => turned(each, attitude));
    const normal = unit(cross(less(world[1], world[0]), less(world[2], world[1])));
    const middle = world.reduce((sum, each) => sum.map((v, k) => v + each[k] / world.length),
      [0, 0, 0]);
    return {world, normal, paint, middle, depth: Math.hypot(...less(middle, eye))};
  }).filter((face) => dot(face.normal, less(face.middle, eye)) < 0);
  faces.sort((one, other) => other.depth - one.depth);
  for (const {world, normal, paint} of faces) {
    ctx.beginPath();
    world.forEach((each, k) => {
      const [x, y] = seen(each);
      if (k) ctx.lineTo(x, y);
      else ctx.moveTo(x, y);
    });
    ctx.closePath();
    ctx.fillStyle = colour(paint);
    ctx.fill();
    ctx.fillStyle = `rgba(0, 0, 0, ${0.5 * (1 - Math.max(0, dot(normal, LIGHT)))})`;
    ctx.fill();
  }
}

/** The level ground, and a line in the direction of yaw 0. */
function ground(ctx, seen) {
  const line = (from, to) => {
    const [x0, y0] = seen(from), [x1, y1] = seen(to);
    ctx.beginPath();
    ctx.moveTo(x0, y0);
    ctx.lineTo(x1, y1);
    ctx.stroke();
  };
  const z = -WHEEL.radius;
  ctx.lineWidth = 1;
  ctx.strokeStyle = colour('--grid');
  for (let k = -3; k <= 3; k++) {
    line([-3, k, z], [3, k, z]);
    line([k, -3, z], [k, 3, z]);
  }
  ctx.strokeStyle = colour('--axis');
  ctx.lineWidth = 2;
  line([0, 0, z], [3, 0, z]);
}
