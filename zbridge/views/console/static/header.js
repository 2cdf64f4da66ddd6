// What is on every page: where we are, STOP ALL, Release, and what came of the last stop.

import { html, useState } from "./vendor/htm-preact.js";
import { logOut } from "./login.js";

export function leave(event) {
  event.currentTarget.blur(); // the space bar would click it again
}

export function Header({ store }) {
  const rows = [...store.rows.values()];
  const latched = rows.filter((row) => row.latched.length).length;
  return html`<header>
    <div class="bar">
      <a class="home" href="#">zbridge <span class="realm">${store.realm}</span></a>
      ${store.me.user && html`<span class="empty">${store.me.user} (${store.me.role})
        <button type="button" onClick=${() => logOut(store.me)}>Log out</button></span>`}
      ${latched > 0 && store.may("unlatch_fleet") && html`<${Release} store=${store} latched=${latched} />`}
      <button
        class="stop-all"
        type="button"
        aria-keyshortcuts="Escape"
        onClick=${(event) => {
          leave(event);
          store.stopAll();
        }}
      >
        STOP ALL
      </button>
    </div>
    <div class="notices" role="status" aria-live="assertive">
      ${(!store.connected || store.silent) && html`<p class="notice bad">The console does not answer: what is shown is old.</p>`}
      ${store.connected && !store.bus && html`<p class="notice bad">The bus is lost: nothing is known of the robots.</p>`}
      ${store.fault && html`<p class="notice bad">The console's own files: ${store.fault}</p>`}
      ${store.warning && html`<${Notice} notice=${store.warning} />`}
      ${["all", "one"].map((of) => store.notices[of] && html`<${Notice} key=${of} notice=${store.notices[of]} />`)}
    </div>
  </header>`;
}

function Notice({ notice }) {
  const tone = notice.good === true ? "good" : notice.good === false ? "bad" : "going";
  const at = new Date(notice.at * 1000).toLocaleTimeString();
  return html`<p class="notice ${tone}"><time>${at}</time> ${notice.text}</p>`;
}

function Release({ store, latched }) {
  const [asked, ask] = useState(false);
  const robots = `${latched} ${latched === 1 ? "robot" : "robots"}`;
  if (!asked) return html`<button type="button" onClick=${() => ask(true)}>Release</button>`;
  const release = () => {
    store.send({ do: "release" });
    ask(false);
  };
  return html`<span class="question">
    ${robots} may be driven again?
    <button type="button" class="sure" onClick=${release}>Release</button>
    <button type="button" onClick=${() => ask(false)}>Cancel</button>
  </span>`;
}
