/** The page: its cards, their tabs on a phone, the topics they show, and when they are drawn. */
import {Air} from './cards/air.js';
import {Attitude, Battery, Motion} from './cards/car.js';
import {Commands} from './cards/commands.js';
import {Drive} from './cards/drive.js';
import {Links, worst} from './cards/links.js';
import {Log} from './cards/log.js';
import {CustomMessages} from './cards/custom.js';
import {Channels, Sensors} from './cards/sensors.js';
import {Wire} from './cards/wire.js';
import {appear} from './appeared.js';
import {Connection} from './connection.js';
import {formatAge, h, updateAttribute, updateText, withoutAges} from './dom.js';
import {flow} from './flow.js';
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
const log = new Log();
// The parts of the page; on a phone each is a tab. The links' card is in index.html.
const tabs = {
  Links: [log], Drive: [drive], Commands: [commands], Car: [new Attitude(), new Motion(), new Battery()],
  Sensors: [new Sensors(), new Channels(), new Air(), custom], Wire: [wire]};
const below = [wire, custom];       // a new card must not move the wire
const cards = [links, ...Object.values(tabs).flat()];
const flowing = [tabs.Car[0], drive, commands, ...cards.slice(1).filter((each) =>
  ![tabs.Car[0], drive, commands, log, ...below].includes(each)), log].map((each) => each.element);

for (const [name, parts] of Object.entries(tabs)) parts.forEach((each) => { each.element.dataset.tab = name; });
place('below').append(...below.map((each) => each.element));
flow(place('columns'), flowing, () => drive.held);

function showTab(name) {
  for (const {element} of cards) {
    updateAttribute(element, 'data-elsewhere', element.dataset.tab !== name);    // has an effect on a phone only
  }
  for (const button of place('tabs').children) {
    updateAttribute(button, 'aria-pressed', String(button.textContent === name));
  }
  scrollTo(0, 0);
  requestAnimationFrame(draw);
}
place('tabs').append(...Object.keys(tabs).map((name) =>
  h('button', {type: 'button', onclick: () => showTab(name)}, name)));
place('stop').addEventListener('click', () => commands.stop());

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
  updateAttribute(place('trouble'), 'title', trouble);
  const health = !alive ? 'lost' : trouble ? 'trouble' : 'live';
  updateText(place('connection'), {lost: 'no connection', trouble: 'not live', live: 'live'}[health]);
  updateAttribute(document.body, 'data-connection', health);
  updateText(place('alarm'), place('trouble').hidden ? '' : withoutAges(trouble));
  place('stop').hidden = model.controls === null;
  updateAttribute(document.body, 'data-control', model.controls !== null);
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
  if ('node' in update) appear();       // the first update of a connection: now there are controls
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
showTab('Links');
watch();
