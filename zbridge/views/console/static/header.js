// What is on every page: where we are, STOP ALL, Release, and what came of the last stop.

import { html, useState } from "./vendor/htm-preact.js";
import { logOut } from "./login.js";
import { counted, leave, span } from "./words.js";

const GOOD_S = 60; // for so long a notice is shown that asks nobody for anything
const SENT = "gateways sent it";

export function Header({ store }) {
  const latched = [...store.rows.values()].filter((row) => row.latched.length).length;
  const live = store.connected && !store.silent && store.bus;
  const stopAll = (event) => {
    leave(event);
    store.stop();
  };
  return html`<header>
    <div class="bar">
      <a class="home" href="#">zbridge console</a>
      <span class="realm">${store.realm}</span>
      <span class="live ${live ? "good" : "bad"}"><b>${live ? "Live" : "Not connected"}</b></span>
      ${store.me.user && html`<span class="user">${store.me.user} (${store.me.role})
        <button type="button" onClick=${() => logOut(store.me)}>Log out</button></span>`}
      <button class="stop-all" type="button" aria-keyshortcuts="Escape" onClick=${stopAll}>STOP ALL</button>
    </div>
    ${latched > 0 && html`<${Latched} store=${store} robots=${counted(latched, "robot")} />`}
    <div class="notices" role="status" aria-live="assertive">
      ${(!store.connected || store.silent) && html`<p class="notice bad">The console does not answer: what is shown is old.</p>`}
      ${store.connected && !store.bus && html`<p class="notice bad">The bus is lost: nothing is known of the robots.</p>`}
      ${store.fault && html`<p class="notice bad">The console's own files: ${store.fault}</p>`}
      ${[...store.stops.values()].map(({ robot, alarm }) => alarm && html`<${Notice} key=${`stop ${robot}`} notice=${alarm} />`)}
      ${store.warning && html`<${Notice} key="warning" notice=${store.warning} />`}
      ${newestFirst(store.notices).map(([robot, notice]) => html`<${Notice} key=${`told ${robot}`} notice=${notice} />`)}
    </div>
  </header>`;
}

// Those of the fleet before those of single robots.
function newestFirst(notices) {
  return Object.entries(notices).sort(([a, one], [b, other]) => Boolean(a) - Boolean(b) || other.at - one.at);
}

function Notice({ notice }) {
  const age = (performance.now() - notice.came) / 1000;
  if (notice.good === true && age > GOOD_S) return null;
  const tone = notice.good === true ? "" : notice.good === false ? "bad" : "going";
  const at = new Date(notice.at * 1000).toLocaleTimeString();
  return html`<p class="notice ${tone}"><time>${at}</time> <span class="empty" aria-hidden="true">${span(age)} ago</span> ${notice.text}
    ${notice.text.includes(SENT) && html` <b>Sent is not stopped: watch the robots.</b>`}</p>`;
}

// Which robots are latched, and how they are released.
function Latched({ store, robots }) {
  const [asked, ask] = useState(false);
  const answer = (yes) => (event) => {
    leave(event);
    if (yes) store.ask({ do: "release" });
    ask(false);
  };
  if (!store.may("unlatch_fleet")) return html`<p class="latched">${robots} latched.</p>`;
  if (!asked) {
    return html`<p class="latched">${robots} latched.
      <button type="button" class="careful" onClick=${() => ask(true)}>Release</button></p>`;
  }
  return html`<p class="latched question">Release ${robots}? Programs and people can move them again at once.
    <button type="button" class="careful" onClick=${answer(true)}>Release ${robots}</button>
    <button type="button" onClick=${answer(false)}>Keep latched</button></p>`;
}
