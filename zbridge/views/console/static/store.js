// What the page knows: the rows of all robots, the last notices, the robot that it looks at, and whether anybody answers.

import { whoAmI } from "./login.js";
import { RobotData } from "./robot_data.js";

const AGAIN_MS = [250, 500, 1000, 2000];
const LOGIN_ENDED = 4401; // the code by which the console closes a page's socket
const KEPT = 60; // rates of a robot that its sparkline shows
const STALE_STOP_MS = 10000;
const SILENT_MS = 3000; // the console says something every 0.5 s
const UNANSWERED_MS = 1500; // it says at once that it sends a stop
const ROBOTS = 8; // robots whose trail and plots are kept while another one is looked at

export class Store {
  // changed: called when anything has changed. me: whom the page acts for. refused: called when the console refuses it.
  constructor(changed, me, refused) {
    this.me = me;
    this.refused = refused;
    this.rows = new Map();
    this.rates = new Map();
    this.notices = {}; // by robot, "" of the fleet
    this.realm = "";
    this.bus = true;
    this.connected = false;
    this.fault = null;
    this.warning = null; // why what this page asked for was not done
    this.changed = changed;
    this.tries = 0;
    this.known = false; // whether the robots have been told
    this.stops = new Map(); // by robot, "" for all: the stops that were pressed here and are not answered
    this.heardAt = performance.now();
    this.looked = "";
    this.robots = new Map(); // by name, the one that was looked at last at the end
    this.connect();
    this.timer = setInterval(() => this.sample(), 1000);
  }

  close() {
    clearInterval(this.timer);
    this.closed = true;
    this.socket.close();
  }

  may(action) {
    return this.me.may.includes(action);
  }

  get silent() {
    return this.connected && performance.now() - this.heardAt > SILENT_MS;
  }

  // What is known of a robot; the trails of the last few are kept.
  data(name) {
    const data = this.robots.get(name) ?? new RobotData(name);
    this.robots.delete(name);
    this.robots.set(name, data);
    if (this.robots.size > ROBOTS) this.robots.delete(this.robots.keys().next().value);
    return data;
  }

  // Asks for what a robot publishes; "": for none.
  look(name) {
    this.looked = name;
    this.robots.get(name)?.begin();
    this.send({ do: "look", robot: name });
  }

  connect() {
    if (this.closed) return;
    const socket = (this.socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/socket`));
    socket.onopen = () => {
      this.tries = 0;
      this.connected = true;
      for (const stop of this.stops.values()) if (performance.now() - stop.at < STALE_STOP_MS) this.sendStop(stop);
      for (const data of this.robots.values()) data.reconnected();
      if (this.looked) this.look(this.looked);
      this.changed();
    };
    socket.binaryType = "arraybuffer";
    socket.onmessage = (event) => {
      this.heardAt = performance.now();
      if (typeof event.data === "string") this.take(JSON.parse(event.data));
      else this.robots.get(this.looked)?.take(new Uint8Array(event.data));
    };
    socket.onclose = (event) => {
      if (this.closed) return;
      for (const stop of this.stops.values()) if (!stop.alarm) this.alarm(stop, "was NOT confirmed: the console does not answer");
      if (event.code === LOGIN_ENDED) return void this.refused();
      if (this.tries > 0) this.checkLogin();
      this.connected = false;
      this.changed();
      setTimeout(() => this.connect(), AGAIN_MS[Math.min(this.tries++, AGAIN_MS.length - 1)]);
    };
  }

  // A socket that never opens does not say why: the login may have ended.
  async checkLogin() {
    const me = await whoAmI().catch(() => this.me);
    if (!me && !this.closed) this.refused();
  }

  take(message) {
    if (message.full) this.rows.clear();
    this.known = this.known || Boolean(message.full);
    if (message.me) this.me = { ...this.me, ...message.me };
    if (message.warning) this.takeRefusal(message);
    for (const row of message.rows ?? []) this.rows.set(row.name, row);
    for (const name of message.gone ?? []) {
      this.rows.delete(name);
      this.rates.delete(name);
    }
    for (const name of ["realm", "bus", "fault"]) if (name in message) this[name] = message[name];
    if (message.notices) this.takeNotices(message.notices, message.now);
    this.changed();
  }

  // now: the console's clock, by which ages are right whatever this clock shows.
  takeNotices(notices, now) {
    for (const [robot, notice] of Object.entries(notices)) notices[robot] = { ...notice, came: performance.now() - 1000 * (now - notice.at) };
    this.notices = notices;
    for (const stop of this.stops.values()) this.compare(stop, notices[stop.robot]);
  }

  // Whether a notice tells of a stop that was pressed here, and whether it is the last word on it.
  compare(stop, notice) {
    if (!notice || notice.came < stop.at) return;
    const answers = notice.action === stop.request.do;
    if (answers && notice.good === null) {
      clearTimeout(stop.timer);
      Object.assign(stop, { heard: true, alarm: null });
    } else if (answers || stop.heard) this.drop(stop.robot);
  }

  sample() {
    for (const [name, row] of this.rows) {
      const rates = this.rates.get(name) ?? [];
      rates.push(row.rate);
      if (rates.length > KEPT) rates.shift();
      this.rates.set(name, rates);
    }
    this.changed(); // ages
  }

  // Why the console does not do what this page asked for.
  takeRefusal({ warning, action, robot }) {
    this.warning = noticed(warning);
    if (this.stops.get(robot)?.request.do === action) this.drop(robot);
  }

  // Returns whether a request was sent.
  send(request) {
    if (this.socket.readyState !== WebSocket.OPEN) return false;
    this.socket.send(JSON.stringify(request));
    return true;
  }

  // Asks for what a person wants, other than stops.
  ask(request) {
    const what = [request.robot, request.name ?? request.do].filter(Boolean).join(": ");
    this.warning = this.send(request) ? null : noticed(`${what} was NOT sent: the console does not answer.`);
    this.changed();
  }

  // Stops a robot, or all (""). What became of it is said: by the console, or else by this page.
  stop(robot = "") {
    this.drop(robot);
    this.warning = null;
    const request = robot ? { do: "stop", robot } : { do: "stop_all" };
    const stop = { robot, request, at: performance.now(), heard: false, alarm: null };
    this.stops.set(robot, stop);
    this.sendStop(stop);
  }

  sendStop(stop) {
    clearTimeout(stop.timer);
    if (!this.send(stop.request)) return this.alarm(stop, "was NOT sent: the console does not answer");
    stop.timer = setTimeout(() => this.alarm(stop, "was sent, and the console has not answered yet"), UNANSWERED_MS);
  }

  alarm(stop, what) {
    clearTimeout(stop.timer);
    const [which, where] = stop.robot ? [`${stop.robot}: the stop`, "robot"] : ["STOP ALL", "robots"];
    stop.alarm = noticed(`${which} ${what}. Use the stop on the ${where}.`);
    this.changed();
  }

  drop(robot) {
    clearTimeout(this.stops.get(robot)?.timer);
    this.stops.delete(robot);
  }
}

// Bad news of this page's own, now.
const noticed = (text) => ({ text, at: Date.now() / 1000, good: false, came: performance.now() });
