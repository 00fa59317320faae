/** Why a command cannot be carried out now; '' if it can. */
import {APPEARED, hasJustAppeared} from './appeared.js';
import {formatAge, withoutAges} from './dom.js';

export const STOPPED = 'stopped until STOP is released';

/**
 * @param link the name of the link that the command needs
 * @param moves whether the bridge refuses it while STOP holds
 */
export function whyNot(model, connection, now, link, moves = false) {
  if (!connection.alive) return 'no connection to the panel';
  if (hasJustAppeared()) return APPEARED;
  const status = model.links.get(link);
  if (!model.links.size) return model.trouble || 'no status of the bridge yet';
  if (!status) return `the ${link} link is off`;
  if (status.at === null) return model.trouble || `no status of the ${link} link yet`;
  if (status.stale(now)) return `the bridge has been silent for ${formatAge(now - status.at)}`;
  const {condition} = status.values;
  if (condition === 'closed') return `the ${link} link is closed`;
  if (condition === 'lent') return `the ${link} link is ${status.summary}`;
  if (condition === 'calibrating') return 'the IMU is being calibrated';
  return moves && model.stopped(now) ? STOPPED : '';
}

/** Likewise for a service, for which the ROS master is asked. The page's head has the trouble in full. */
export function whyNoCall(model, connection, now, link) {
  return whyNot(model, connection, now, link) || withoutAges(model.trouble).replace(/ at http:\S+$/, '');
}
