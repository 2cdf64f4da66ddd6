// What the page knows: the rows of all robots, the last notices, the robot that it looks at, and whether anybody answers.

import { whoAmI } from "./login.js";
import { RobotData } from "./robot_data.js";

const AGAIN_MS = [250, 500, 1000, 2000];
const REFUSED = 1008; // the code by which the console ends a page whose login has ended
const KEPT = 60; // rates of a robot that its sparkline shows
const STALE_STOP_MS = 10000;
const SILENT_MS = 6000; // the console says something every 2 s
const UNANSWERED_MS = 1500; // it says at once that it sends STOP ALL
const ROBOTS = 8; // robots whose trail and plots are kept while another one is looked at

export class Store {
  // changed: called when anything has changed. me: whom the page acts for. refused: called when the console refuses it.
  constructor(changed, me, refused) {
    this.me = me;
    this.refused = refused;
    this.rows = new Map();
    this.rates = new Map();
    this.notices = {};
    this.realm = "";
    this.bus = true;
    this.connected = false;
    this.fault = null;
    this.warning = null; // why what this page asked for was not done
    this.changed = changed;
    this.tries = 0;
    this.known = false; // whether the robots have been told
    this.stopAt = null; // when STOP ALL was asked for and nobody answered
    this.unanswered = null; // runs while STOP ALL is not answered
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
    if (name) this.robots.get(name)?.reconnected();
    this.send({ do: "look", robot: name });
  }

  connect() {
    const socket = (this.socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/socket`));
    socket.onopen = () => {
      this.tries = 0;
      this.connected = true;
      if (this.stopAt !== null && Date.now() - this.stopAt < STALE_STOP_MS) this.send({ do: "stop_all" });
      this.stopAt = null;
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
      if (event.code === REFUSED) return void this.refused();
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
    if (message.notices?.all) this.clearUnanswered();
    if (message.me) this.me = { ...this.me, ...message.me };
    if (message.warning) this.warning = noticed({ text: message.warning, at: Date.now() / 1000, good: false });
    for (const row of message.rows ?? []) this.rows.set(row.name, row);
    for (const name of message.gone ?? []) {
      this.rows.delete(name);
      this.rates.delete(name);
    }
    for (const name of ["realm", "bus", "fault"]) if (name in message) this[name] = message[name];
    if (message.notices) this.takeNotices(message.notices);
    this.changed();
  }

  takeNotices(notices) {
    for (const [of, notice] of Object.entries(notices)) {
      const before = this.notices[of];
      notices[of] = notice.at === before?.at && notice.text === before.text ? before : noticed(notice);
    }
    this.notices = notices;
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

  send(request) {
    this.warning = null;
    if (this.socket.readyState === WebSocket.OPEN) {
      this.socket.send(JSON.stringify(request));
      return true;
    }
    return false;
  }

  stopAll() {
    this.clearUnanswered();
    if (this.send({ do: "stop_all" })) {
      const text = "STOP ALL: the console has not answered yet. Use the stop on the robots.";
      this.unanswered = setTimeout(() => this.warn(text), UNANSWERED_MS);
      return;
    }
    this.stopAt = Date.now();
    this.warn("STOP ALL was NOT sent: the console does not answer. Use the stop on the robots.");
  }

  clearUnanswered() {
    clearTimeout(this.unanswered);
  }

  warn(text) {
    this.notices = { all: noticed({ text, at: Date.now() / 1000, good: false }) };
    this.changed();
  }
}

// A notice, and when it came by the page's own clock.
const noticed = (notice) => ({ ...notice, came: performance.now() });
