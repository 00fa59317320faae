/** The page: its cards, and when they are drawn. */
import {Car} from './cards/car.js';
import {Commands} from './cards/commands.js';
import {Drive} from './cards/drive.js';
import {Links, worst} from './cards/links.js';
import {Log} from './cards/log.js';
import {Topics} from './cards/topics.js';
import {Wire} from './cards/wire.js';
import {Connection} from './connection.js';
import {setAttribute, setText} from './dom.js';
import {Model} from './model.js';

const NUMBERS = 200;    // ms between two drawings
const PLOTS = 300;      // … of the plots
const STOPPED = 'stopped until STOP is released';

const place = (id) => document.getElementById(id);

const model = new Model();
const connection = new Connection();
const topics = new Topics(place('cards'));
const commands = new Commands(connection, model);
const drive = new Drive(connection, model);
const car = new Car();
const wire = new Wire(connection);
const log = new Log();
const links = new Links(place('links'));
const cards = [links, drive, commands, car, topics, wire, log];
place('pause').addEventListener('click', () => {
  topics.hold(!topics.held);
  setAttribute(place('pause'), 'aria-pressed', String(topics.held));
});
place('cards').append(car.element);
place('control').append(drive.element, commands.element, log.element);
place('below').append(wire.element);
let wall = 0;           // what to add to a time of the panel for the time of the day, s

/** Show connection, STOP, and the bridge's trouble in the page's head and title. */
function drawHead(now) {
  const alive = connection.alive;
  const stopped = model.stopped(now);
  const trouble = alive ? model.trouble : `no connection: ${connection.words}`;
  const words = [commands.stopTrouble(now), trouble, stopped ? STOPPED : '']
    .filter(Boolean).join('; ');
  setText(place('trouble'), words);
  setAttribute(place('trouble'), 'data-stopped', words === STOPPED || null);
  const health = !alive ? 'no connection' : model.trouble ? 'not live' : 'live';
  setText(place('connection'), health);
  setAttribute(document.body, 'data-connection', health);
  setAttribute(document.body, 'data-control', model.control || null);
  place('stop').hidden = !model.control;
  setAttribute(place('stop'), 'aria-pressed', String(stopped));
  setText(place('node'), model.node.replace(/^\//, '') || 'serial_communication');
  const sign = !alive ? '✕ no connection' : words ? `✕ ${words}` : worst(model, now);
  setText(document.querySelector('title'), `${sign} · ${place('node').textContent}`);
}

function draw() {
  if (document.hidden) return;
  const now = connection.now();
  drawHead(now);
  for (const each of cards) {
    try {
      each.draw(model, now, wall);
    } catch (error) {       // draw the other cards nevertheless
      console.error(error);
    }
  }
}

connection.addEventListener('update', ({detail: update}) => {
  wall = update.wall;
  model.take(update);
});
setInterval(() => requestAnimationFrame(draw), NUMBERS);
setInterval(() => requestAnimationFrame(() => {
  if (connection.alive) topics.drawPlots(connection.now() + wall);
}), PLOTS);
