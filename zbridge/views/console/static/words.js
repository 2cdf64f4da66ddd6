// The words of all pages: what a row's state is called, who drives, and how ages are written.

// By the state of a row: its word, its tone, and what a person must know before trusting "Stop".
const STATES = {
  established: ["Connected", "good", ""],
  LATCHED: ["Latched", "wait", ""],
  stalled: ["Stalled", "bad", "The robot does not acknowledge commands."],
  offline: ["Offline", "bad", "No contact with this robot."],
  closing: ["Closing", "bad", "No contact with this robot."],
  connecting: ["Connecting", "bad", "No contact with this robot yet."],
  handshaking: ["Handshake", "bad", "No contact with this robot yet."],
  unknown: ["Unknown", "bad", "It is not known whether this robot can be reached."],
  SILENT: ["Silent", "bad", "No contact with the gateway of this robot."],
  "NO GATEWAY": ["No gateway", "bad", "No contact with this robot: it has no gateway."],
};
const UNKNOWN_DRIVER = ["SILENT", "NO GATEWAY", "unknown"];

export function wordOf(row) {
  return row.state === "established" && row.driver === "stopped" ? "Stopped" : (STATES[row.state]?.[0] ?? row.state);
}

export function toneOf(row) {
  return wordOf(row) === "Stopped" ? "wait" : (STATES[row.state]?.[1] ?? "bad");
}

// Why a stop may not reach the robot; "" if nothing is known that speaks against it.
export const doubtOf = (row) => STATES[row.state]?.[2] ?? STATES.unknown[2];

// The name of who drives; "" for nobody, null if it is not known.
export function driverOf(row) {
  if (UNKNOWN_DRIVER.includes(row.state)) return null;
  return ["stopped", "LATCHED"].includes(row.driver) ? "" : row.driver;
}

export function whyOf(row) {
  const seen = row.seen !== null ? `last seen ${span(Date.now() / 1000 - row.seen)} ago` : "";
  return [seen, row.reason].filter(Boolean).join("; ");
}

export function span(seconds) {
  const age = Math.max(0, Math.round(seconds));
  if (age < 120) return `${age} s`;
  return age < 7200 ? `${Math.round(age / 60)} min` : `${Math.round(age / 3600)} h`;
}

export const counted = (count, one) => `${count} ${one}${count === 1 ? "" : "s"}`;

export function leave(event) {
  event.currentTarget.blur(); // the space bar would click it again
}
