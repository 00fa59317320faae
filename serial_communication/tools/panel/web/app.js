/** The page: its cards, the topics they show, and when they are drawn. */
import {Air} from './cards/air.js';
import {Attitude, Battery, Motion} from './cards/car.js';
import {Commands} from './cards/commands.js';
import {Drive} from './cards/drive.js';
import {Links, worst} from './cards/links.js';
import {Log} from './cards/log.js';
import {CustomMessages} from './cards/custom.js';
import {Channels, Sensors} from './cards/sensors.js';
import {Wire} from './cards/wire.js';
import {Connection} from './connection.js';
import {formatAge, updateAttribute, updateText} from './dom.js';
import {Model} from './model.js';

const IDLE = 200;         // ms between two drawings while no update is received

const place = (id) => document.getElementById(id);
const announce = (words) => { place('announcer').textContent = words; };

const model = new Model();
const connection = new Connection();
const links = new Links(announce);
const custom = new CustomMessages();
const commands = new Commands(connection, announce);
const drive = new Drive(connection, announce);
const wire = new Wire(watch);
const columns = [[new Attitude(), drive, new Battery()], [new Motion(), new Log()],
  [commands, new Sensors(), new Channels(), new Air()]];
const below = [custom, wire];
const cards = [links, ...columns.flat(), ...below];

columns.forEach((column, index) => place(`column-${index + 1}`).append(...column.map((each) => each.element)));
place('below').append(...below.map((each) => each.element));

function watch() {
  connection.watch(new Set(cards.flatMap((each) => each.topics)));
}

/** Show the connection, the bridge's trouble and the worst link in the page's head and title. */
function drawHead(now) {
  const alive = connection.alive;
  const state = worst(model, now);
  const trouble = alive ? model.trouble
    : connection.seen ? `no connection to the panel for ${formatAge(Math.max(0, now - connection.seen))}: ${connection.words}` : connection.words;
  place('trouble').hidden = !trouble || !connection.seen && connection.words === 'connecting …';
  updateText(place('trouble'), trouble);
  updateText(place('connection'), alive ? 'live' : 'no connection');
  updateAttribute(document.body, 'data-connection', alive ? 'live' : 'lost');
  updateText(place('node'), model.node.replace(/^\//, '') || 'serial_communication');
  const sign = !alive ? '✕ no connection' : trouble ? `✕ ${trouble}` : state.words ? `${state.sign} ${state.words}` : '✓';
  const title = `${sign} · ${place('node').textContent}`;
  if (document.title !== title) document.title = title;
}

let requested = false;
let drawnAt = 0;

function draw() {
  requested = false;
  drawnAt = performance.now();
  const now = connection.now();
  drawHead(now);
  for (const each of cards) {
    try {
      each.draw(model, now);
    } catch (error) {       // draw the other cards nevertheless
      console.error(error);
    }
  }
}

function drawSoon() {
  if (requested) return;
  requested = true;
  requestAnimationFrame(draw);
}

connection.addEventListener('update', ({detail: update}) => {
  model.take(update);
  if (update.known && custom.learn(update.known)) watch();
  if (update.wire) wire.take(update.wire);
  if (update.refused) {
    if (update.refused.key === 'drive') drive.refused(update.refused.words);
    else commands.refused(update.refused);
  }
  drawSoon();
});
setInterval(() => { if (performance.now() - drawnAt > IDLE) drawSoon(); }, IDLE);
watch();
