// The console's pages. The part of the address behind # says which: nothing, or /robot/<name>.

import { html, render } from "./vendor/htm-preact.js";
import { Fleet } from "./fleet.js";
import { Header } from "./header.js";
import { Login, whoAmI } from "./login.js";
import { Store } from "./store.js";

const AGAIN_MS = 1000;

let scheduled = false;
let store = null;
const lost = []; // what is said of stops that were not answered before the login ended
let Robot = null; // loaded with the first page of a robot: the fleet is painted sooner

async function loadRobot() {
  ({ Robot } = await import("./robot.js"));
  draw();
}

function draw() {
  if (scheduled) return;
  scheduled = true;
  requestAnimationFrame(() => {
    scheduled = false;
    if (!store) return;
    const name = namedRobot();
    document.title = `${name ?? store.realm ?? "fleet"} - zbridge console`;
    if (name !== null && !Robot) loadRobot();
    const page = name === null ? html`<${Fleet} store=${store} />` : Robot && html`<${Robot} store=${store} name=${name} />`;
    render(html`<${Header} store=${store} /><main>${page}</main>`, document.body);
  });
}

// The robot whose page the address names; null: none.
function namedRobot() {
  try {
    return location.hash.startsWith("#/robot/") ? decodeURIComponent(location.hash.slice(8)) : null;
  } catch {
    return null; // it is cut off, or was typed wrongly
  }
}

function begin(me) {
  lost.length = 0;
  render(null, document.body); // nothing of a page belongs to the store before
  store = new Store(draw, me, start);
  draw();
}

// Asks who this page acts for, at the beginning and whenever its login may have ended. What became of the stops that
// were pressed before, and are not answered, stays in sight.
async function start() {
  for (const { alarm } of store?.stops.values() ?? []) if (alarm) lost.push(alarm.text);
  store?.close();
  store = null;
  render(html`<${Nobody} lost=${lost} />`, document.body);
  try {
    const me = await whoAmI();
    if (me) begin(me);
    else render(html`<${Nobody} lost=${lost} /><${Login} done=${begin} />`, document.body);
  } catch {
    setTimeout(start, AGAIN_MS);
  }
}

function Nobody({ lost }) {
  return html`<div role="alert" class="nobody">
    <p class="notice">Not connected: STOP ALL and Escape do nothing on this page.</p>
    ${lost.map((text) => html`<p class="notice bad">${text}</p>`)}
  </div>`;
}

addEventListener("hashchange", draw);
addEventListener("resize", draw);
// Escape stops wherever the page receives it: before any control does.
addEventListener(
  "keydown",
  (event) => {
    if (event.key === "Escape" && !event.repeat && store) {
      event.preventDefault();
      store.stop();
    }
  },
  { capture: true },
);
start();
