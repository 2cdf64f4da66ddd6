// Reads a robot's messages. A message that does not have the fields of its key, or not of their types, is null.

import { floats, unpack } from "./msgpack.js";

const isMap = (value) => value !== null && typeof value === "object" && !Array.isArray(value) && !(value instanceof Uint8Array);
const isText = (value) => typeof value === "string";
const isList = (each) => (value) => Array.isArray(value) && value.every(each);
const isNumber = Number.isFinite;
const optional = (check) => (value) => value === null || value === undefined || check(value);
const fields = (checks) => (value) => isMap(value) && Object.entries(checks).every(([name, check]) => check(value[name]));
const isCells = (map) => Number.isInteger(map.rows * map.columns) && map.cells.length === map.rows * map.columns && map.cell > 0;
const isBin = (value) => value instanceof Uint8Array;
const isFlag = (value) => typeof value === "boolean";
const numbers = (...names) => fields(Object.fromEntries(names.map((name) => [name, isNumber])));

const isProcess = fields({ cpu: isNumber, resident_bytes: isNumber, proportional_bytes: optional(isNumber) });
const isSession = fields({ name: isText, peer: optional(isText), state: isText, transport: optional(isText), version: optional(isText), reason: optional(isText) });
const isSessions = fields({ sessions: isList(isSession) });

const KEYS = {
  pose: numbers("x", "y", "heading"),
  scan: (message) => numbers("angle_min", "angle_increment", "range_min", "range_max")(message) && isBin(message.ranges),
  map: (message) => fields({ cell: isNumber, origin: isList(isNumber), cells: isBin })(message) && isCells(message),
  motion: fields({ speed: optional(isNumber), temperature: optional(isNumber) }),
  battery: fields({ level: optional(isNumber) }),
  image: fields({ format: isText, data: isBin }),
  text: fields({ text: isText, kind: optional(isText), sender: optional(isText) }),
  status: fields({ links: optional(isList(fields({ name: isText, state: isText, peer: isText }))) }),
  control: fields({
    refusals: optional(isList(fields({ command: isText, reason: isText, count: isNumber }))),
    latches: optional(isList(isMap)),
  }),
  lidar: fields({ on: isFlag }),
  camera: fields({ on: isFlag }),
  devices: fields({ devices: isList(fields({ name: isText, kind: isText })) }),
  sensor: fields({ value: isNumber, kind: optional(isText) }),
  "@gateway": (message) => fields({ process: isProcess, rates: isMap })(message) && Object.values(message.rates).every(isNumber),
  "@history": isList(fields({ at: isNumber, text: isText })),
  "@sessions": isMap,
};

// Returns the message of a path below the robot; null if it cannot be read.
export function readMessage(path, payload) {
  try {
    const message = unpack(payload);
    const check = KEYS[path.split("/")[0]] ?? isMap;
    if (!check(message)) return null;
    if (path === "scan") message.ranges = floats(message.ranges);
    return path === "@sessions" ? readSessions(message) : message;
  } catch (error) {
    if (error instanceof RangeError) return null;
    throw error;
  }
}

// The sessions of all processes; what a process tells that cannot be read is left out.
function readSessions(tables) {
  return Object.entries(tables).flatMap(([process, payload]) => {
    const table = isBin(payload) ? readMessage("sessions", payload) : null;
    return isSessions(table) ? table.sessions.map((session) => ({ process, ...session })) : [];
  });
}
