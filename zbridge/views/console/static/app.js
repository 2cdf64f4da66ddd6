// The console's pages. The part of the address behind # says which: nothing, or /robot/<name>.

import { html, render } from "./vendor/htm-preact.js";
import { Fleet } from "./fleet.js";
import { Header } from "./header.js";
import { Login, whoAmI } from "./login.js";
import { Store } from "./store.js";

const AGAIN_MS = 1000;

let scheduled = false;
let store = null;
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
  render(null, document.body); // nothing of a page belongs to the store before
  store = new Store(draw, me, start);
  draw();
}

// Asks who this page acts for, at the beginning and whenever its login may have ended.
async function start() {
  store?.close();
  store = null;
  try {
    const me = await whoAmI();
    if (me) begin(me);
    else render(html`<${Login} done=${begin} />`, document.body);
  } catch {
    setTimeout(start, AGAIN_MS);
  }
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
