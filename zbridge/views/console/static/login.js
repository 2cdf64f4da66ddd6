// Logging in and out, where the console has users.

import { html, useState } from "./vendor/htm-preact.js";

// Who the page acts for: name, role and rights; null: nobody is logged in. Throws if the console does not answer.
export async function whoAmI() {
  const answer = await fetch("/api/me", { cache: "no-store" });
  if (answer.status === 401) return null;
  if (!answer.ok) throw new Error(`the console answered ${answer.status}`);
  return answer.json();
}

export async function logOut(me) {
  await fetch("/api/logout", { method: "POST", headers: { "x-zbridge-csrf": me.csrf } });
  location.reload();
}

export function Login({ done }) {
  const [problem, setProblem] = useState("");
  const [busy, setBusy] = useState(false);
  const submit = async (event) => {
    event.preventDefault();
    const fields = event.currentTarget.elements;
    setBusy(true);
    try {
      const body = JSON.stringify({ user: fields.user.value, password: fields.password.value });
      const answer = await fetch("/api/login", { method: "POST", body });
      const told = await answer.json();
      if (answer.ok) done(told);
      else setProblem(told.error);
    } catch {
      setProblem("The console does not answer.");
    }
    setBusy(false);
  };
  return html`<main><form class="login panel" onSubmit=${submit}>
    <h1>zbridge console</h1>
    <label>User <input name="user" autocomplete="username" required /></label>
    <label>Password <input name="password" type="password" autocomplete="current-password" required /></label>
    <button type="submit" disabled=${busy}>Log in</button>
    <p role="alert" class="age">${problem}</p>
  </form></main>`;
}
