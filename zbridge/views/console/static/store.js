// What the page knows: the rows of all robots, the last notice, and whether anybody answers.

const AGAIN_MS = [250, 500, 1000, 2000];
const KEPT = 60; // rates of a robot that its sparkline shows
const STALE_STOP_MS = 10000;

export class Store {
  constructor(changed) {
    this.rows = new Map();
    this.rates = new Map();
    this.notices = {};
    this.realm = "";
    this.bus = true;
    this.connected = false;
    this.roster = null;
    this.changed = changed;
    this.tries = 0;
    this.stopAt = null; // when STOP ALL was asked for and nobody answered
    this.connect();
    setInterval(() => this.sample(), 1000);
  }

  connect() {
    const socket = (this.socket = new WebSocket(`ws://${location.host}/socket`));
    socket.onopen = () => {
      this.tries = 0;
      this.connected = true;
      if (this.stopAt !== null && Date.now() - this.stopAt < STALE_STOP_MS) this.send({ do: "stop_all" });
      this.stopAt = null;
      this.changed();
    };
    socket.onmessage = (event) => this.take(JSON.parse(event.data));
    socket.onclose = () => {
      this.connected = false;
      this.changed();
      setTimeout(() => this.connect(), AGAIN_MS[Math.min(this.tries++, AGAIN_MS.length - 1)]);
    };
  }

  take(message) {
    if (message.full) this.rows.clear();
    for (const row of message.rows ?? []) this.rows.set(row.name, row);
    for (const name of message.gone ?? []) {
      this.rows.delete(name);
      this.rates.delete(name);
    }
    for (const name of ["realm", "bus", "notices", "roster"]) if (name in message) this[name] = message[name];
    this.changed();
  }

  sample() {
    for (const [name, row] of this.rows) {
      const rates = this.rates.get(name) ?? [];
      rates.push(row.rate);
      if (rates.length > KEPT) rates.shift();
      this.rates.set(name, rates);
    }
  }

  send(request) {
    if (this.socket.readyState === WebSocket.OPEN) {
      this.socket.send(JSON.stringify(request));
      return true;
    }
    return false;
  }

  stopAll() {
    if (this.send({ do: "stop_all" })) return;
    this.stopAt = Date.now();
    const text = "STOP ALL was NOT sent: the console does not answer. Use the stop on the robots.";
    this.notices = { all: { text, at: Date.now() / 1000, good: false } };
    this.changed();
  }
}
