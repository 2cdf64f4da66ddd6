// What is known of the robot that the page looks at: its newest messages, their ages, its trail and its last minutes.

import { readMessage } from "./messages.js";
import { unpack } from "./msgpack.js";

export const MINUTES_S = 120; // how far plots go back
const SAMPLE_S = 0.25;
const TRAIL_POINTS = 2000;
const TRAIL_M = 0.05;
const JUMP_M = 1; // a farther pose begins the trail anew: the robot was carried, or has a new origin
const TEXTS = 100;
const UNKNOWN_PERIOD_S = 1; // of a key that came once
const SHORTEST_OLD_S = 0.3; // pages get pictures 15 times a second: less would flicker
const OLD_PERIODS = 3;
const STAYS = ["map", "status", "control", "devices", "scanner", "lidar", "camera", "@history", "@sessions"];

export class RobotData {
  constructor(name) {
    this.name = name;
    this.entries = new Map(); // by path: when it came and its period (seconds of the server's clock), payload, message
    this.texts = [];
    this.trail = [];
    this.poses = []; // the last second, with the robot's stamps
    this.history = { at: [], series: new Map() }; // what plots show; series by name
    this.began = performance.now() / 1000;
    this.offset = null; // the page's clock minus the server's
    this.offsetAt = 0;
    this.away = false; // nothing comes from it now, whatever was seen last
    this.changed = () => {};
  }

  // The console sends all anew to a page that looks, also the texts.
  begin() {
    this.texts = [];
  }

  // Another console, or another machine, has another clock: what came before has no age any more.
  reconnected() {
    this.entries.clear();
    this.poses = [];
    this.offset = null;
  }

  // Takes one message of the server; drops what is of another robot.
  take(bytes) {
    const frame = unpack(bytes);
    if (frame.robot !== this.name) return;
    this.compareClocks(frame.now);
    for (const [path, came, period, payload] of frame.news) this.takeOne(path, came, period, payload);
    this.changed();
  }

  // The least difference ever seen is that of a message without delay; clocks drift apart by 1 ms a second at most.
  compareClocks(serverNow) {
    const now = performance.now() / 1000;
    const difference = now - serverNow;
    const known = this.offset === null ? Infinity : this.offset + 0.001 * (now - this.offsetAt);
    this.offset = Math.min(difference, known);
    this.offsetAt = now;
  }

  takeOne(path, came, period, payload) {
    const message = readMessage(path, payload);
    if (path === "text") {
      if (message) this.texts.push({ came, ...message });
      if (this.texts.length > TEXTS) this.texts.shift();
      return;
    }
    this.entries.set(path, { came, period, message });
    if (path === "pose" && message) this.takePose(message);
  }

  takePose({ x, y, heading, stamp_ns }) {
    const pose = { x, y, heading, at: seconds(stamp_ns) };
    this.poses.push(pose);
    while (pose.at - this.poses[0].at > 1 || this.poses.length > 50) this.poses.shift();
    const last = this.trail.at(-1);
    const way = last ? Math.hypot(x - last.x, y - last.y) : Infinity;
    if (way < TRAIL_M) return;
    this.trail.push({ x, y, begins: way > JUMP_M });
    if (this.trail.length > TRAIL_POINTS) this.trail.shift();
  }

  // The newest message of a key; null if there is none, or none that can be read.
  message(path) {
    return this.entries.get(path)?.message ?? null;
  }

  // Seconds since the server received the newest message of a key; Infinity if there is none.
  age(path) {
    const entry = this.entries.get(path);
    return entry ? this.ageOf(entry.came) : Infinity;
  }

  ageOf(came) {
    return Math.max(0, performance.now() / 1000 - this.offset - came);
  }

  // Whether a key has been silent for three of its periods. A state that came once stays as it is.
  isOld(path) {
    const entry = this.entries.get(path);
    if (!entry) return true;
    if (!entry.period && STAYS.includes(path)) return false;
    return this.age(path) > Math.max(OLD_PERIODS * (entry.period || UNKNOWN_PERIOD_S), SHORTEST_OLD_S);
  }

  // Where the robot was when something was measured; the newest pose where stamps do not tell.
  poseAt(stamp_ns) {
    const newest = this.poses.at(-1);
    if (!newest) return null;
    const at = seconds(stamp_ns);
    const later = this.poses.findIndex((pose) => pose.at >= at);
    if (later <= 0) return later < 0 || !at ? newest : this.poses[0];
    const [a, b] = [this.poses[later - 1], this.poses[later]];
    const part = (at - a.at) / Math.max(b.at - a.at, 1e-9);
    const turn = Math.atan2(Math.sin(b.heading - a.heading), Math.cos(b.heading - a.heading));
    return { x: a.x + part * (b.x - a.x), y: a.y + part * (b.y - a.y), heading: a.heading + part * turn };
  }

  // Metres a second, by the poses of the last second; null without them.
  speedByPose() {
    const [first, last] = [this.poses[0], this.poses.at(-1)];
    if (!first || this.isOld("pose") || last.at - first.at < 0.2) return null;
    return Math.hypot(last.x - first.x, last.y - first.y) / (last.at - first.at);
  }

  // The names of the sensors, sorted, with their paths.
  sensors() {
    const paths = [...this.entries.keys()].filter((path) => path.startsWith("sensor/"));
    return paths.map((path) => [sensorName(path.slice(7)), path]).sort(([a], [b]) => a.localeCompare(b));
  }

  // Notes what plots show, four times a second: values by name; what is old, or not known, is a gap.
  sample(values) {
    const { at, series } = this.history;
    const now = Date.now() / 1000;
    if (at.length && now - at.at(-1) < 0.8 * SAMPLE_S) return;
    at.push(now);
    for (const [name, value] of Object.entries(values)) {
      if (!series.has(name)) series.set(name, Array(at.length - 1).fill(null));
      series.get(name).push(Number.isFinite(value) ? value : null);
    }
    for (const row of series.values()) if (row.length < at.length) row.push(null);
    while (at[0] < now - MINUTES_S) {
      at.shift();
      for (const row of series.values()) row.shift();
    }
  }
}

const seconds = (stamp_ns) => (Number.isFinite(stamp_ns) ? stamp_ns / 1e9 : 0);

function sensorName(chunk) {
  if (chunk === "%") return "(unnamed)";
  try {
    return decodeURIComponent(chunk);
  } catch {
    return chunk;
  }
}
