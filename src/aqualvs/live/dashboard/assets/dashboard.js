// The page's half of the conversation: greet, show what comes, ask for what the pilot wants.
"use strict";

const $ = (id) => document.getElementById(id);
const strips = {
  range: new Strip($("strip-range"), "Range", "m", 0.05, false),
  yaw: new Strip($("strip-yaw"), "Yaw", "°", 4, false),
  pitch: new Strip($("strip-pitch"), "Pitch", "°", 4, true),
};
// After so long without news the numbers are old, whatever the last message said.
const STALE_MS = 600;
// The nearest point in multiples of the least range of the rig: red, and amber.
const TOO_NEAR = 1.2, NEAR = 1.5;
// What is no error to a pilot, in metres and degrees.
const ON_RANGE = 0.02, ON_YAW = 2;
let rig = null;
let state = null;
let socket = null;
let newsAt = 0;
let dirty = false;

/** The token comes behind the # of the address, which browsers send nowhere, and is kept here. */
function token() {
  const given = new URLSearchParams(location.hash.slice(1)).get("token");
  if (given) {
    sessionStorage.setItem("token", given);
    history.replaceState(null, "", location.pathname);
  }
  return sessionStorage.getItem("token") || "";
}

function connect() {
  const scheme = location.protocol === "https:" ? "wss" : "ws";
  socket = new WebSocket(`${scheme}://${location.host}/live`);
  socket.binaryType = "arraybuffer";
  socket.onopen = () => say({ kind: "hello", token: token() });
  socket.onmessage = ({ data }) => (typeof data === "string" ? hear(JSON.parse(data)) : show(data));
  socket.onclose = ({ reason }) => {
    link("closed", reason || "no connection");
    // Without the right token there is no use in trying again before somebody gives one.
    const ask = reason.endsWith("token");
    $("ask").hidden = !ask;
    if (!ask) setTimeout(connect, 1000);
  };
}

const say = (message) => {
  if (socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify(message));
};

function link(kind, words) {
  document.body.dataset.link = kind;
  $("link").textContent = words;
}

function hear(message) {
  if (message.kind === "rig") greet(message);
  else if (message.kind === "refused") answer(message.why);
  else if (message.kind === "state") take(message);
}

function greet(message) {
  rig = message;
  link("open", rig.may_command ? "live" : "live, watching only");
  $("rig").textContent = rig.name;
  document.title = `${rig.name} – aqualvs`;
  const names = rig.lasers.map((laser) => {
    const name = document.createElement("b");
    name.textContent = laser.name;
    name.style.borderColor = laser.colour;
    return name;
  });
  $("plane-names").replaceChildren(...names);
  $("set-name").textContent = rig.holds ? "Hold" : "Aim at";
  const [near, far] = rig.working_range_m;
  Object.assign($("set-range"), { min: near, max: far, placeholder: `${near}–${far}` });
  for (const element of document.querySelectorAll("#commands button, #commands input")) element.disabled = !rig.may_command;
  answer(rig.may_command ? "" : "To record and to set an aim, open the page with its token.", true);
}

/** What became of a command; in red, unless it is a note. */
function answer(words, note = false) {
  $("answer").textContent = words;
  $("answer").classList.toggle("note", note);
}

function take(message) {
  state = message;
  newsAt = performance.now();
  const { posture, setpoint } = message;
  pointsOf.set(Number(posture.frame), message.points);
  if (pointsOf.size > 64) pointsOf.delete(pointsOf.keys().next().value);
  const valid = posture.valid === "1";
  const time = message.utc_ms / 1000;
  const number = (text) => (valid ? Number(text) : null);
  strips.range.add(time, number(posture.range_m), Number(posture.sigma_range_total_m), setpoint && setpoint.range_m);
  strips.yaw.add(time, number(posture.yaw_deg), Number(posture.sigma_yaw_total_deg), setpoint && setpoint.yaw_deg);
  strips.pitch.add(time, number(posture.pitch_deg), Number(posture.sigma_pitch_total_deg), null);
  dirty = true;
}

/** Points of the last frames: a picture may come later than the state of its frame. */
const pointsOf = new Map();

/** A picture: four bytes with the number of its frame, then a JPEG. */
async function show(data) {
  try {
    const frame = new DataView(data).getInt32(0);
    const picture = await createImageBitmap(new Blob([new Uint8Array(data, 4)], { type: "image/jpeg" }));
    const canvas = $("video");
    if (canvas.width !== picture.width || canvas.height !== picture.height) Object.assign(canvas, { width: picture.width, height: picture.height });
    delete $("picture").dataset.empty;
    canvas.getContext("2d").drawImage(picture, 0, 0);
    picture.close();
    if (rig && pointsOf.has(frame)) drawPoints(canvas, pointsOf.get(frame), rig);
  } finally {
    say({ kind: "shown" });
  }
}

function draw() {
  const stale = performance.now() - newsAt > STALE_MS;
  if (state && rig && (dirty || stale)) {
    dirty = false;
    numbers(stale);
    health(stale);
    commands();
    drawTop($("top"), state, rig);
    drawPlane($("plane"), state, rig);
    Object.values(strips).forEach((strip) => strip.draw());
  }
  setTimeout(() => requestAnimationFrame(draw), 60);
}

function numbers(stale) {
  const { posture } = state;
  const valid = posture.valid === "1" && !stale;
  const box = $("numbers");
  box.dataset.valid = valid ? "1" : "0";
  Object.assign(box.dataset, { frame: posture.frame, range: posture.range_m, yaw: posture.yaw_deg, pitch: posture.pitch_deg, sigma: posture.sigma_range_total_m });
  const put = (id, text, digits, sign) => {
    const value = Number(text);
    $(id).textContent = valid ? sign ? signed(value) : value.toFixed(digits) : "–";
  };
  put("range", posture.range_m, 3, false);
  put("yaw", posture.yaw_deg, 1, true);
  put("pitch", posture.pitch_deg, 1, true);
  $("sigma-range").textContent = valid ? `± ${(1000 * posture.sigma_range_total_m).toFixed(1)} mm` : "";
  $("sigma-yaw").textContent = valid ? `± ${Number(posture.sigma_yaw_total_deg).toFixed(2)}°` : "";
  $("sigma-pitch").textContent = valid ? `± ${Number(posture.sigma_pitch_total_deg).toFixed(2)}°` : "";
  const words = stale ? "no news from the system" : state.detail || posture.reason;
  $("reason").textContent = valid ? "" : `No posture: ${words}`;
  guide(valid, stale);
  const dead = stale || posture.reason === "no_frames" || posture.reason === "frozen";
  document.body.dataset.dead = dead ? "1" : "0";
  $("veil").hidden = !dead;
  $("veil").textContent = dead ? words : "";
  $("n-water").textContent = state.n_water;
  $("n-sigma").textContent = state.health.sigma_n_water === null ? "" : `± ${state.health.sigma_n_water.toFixed(4)}`;
  const smooth = stale ? null : state.filtered;
  $("smooth").textContent = smooth ? `Filtered: ${smooth.range_m.toFixed(3)} m, yaw ${smooth.yaw_deg.toFixed(1)}°, pitch ${smooth.pitch_deg.toFixed(1)}°` : "";
}

/** What to do: how far to go and to turn, from the setpoint or else to stand square. */
function guide(valid, stale) {
  const { posture, setpoint, vehicle } = state;
  const nearest = Number(posture.nearest_m) / rig.working_range_m[0];
  const level = nearest < TOO_NEAR ? "bad" : nearest < NEAR ? "warn" : "ok";
  const off = setpoint && Number(posture.range_m) - setpoint.range_m;
  const way = Math.abs(off) < ON_RANGE ? "✓ on range" : `${off > 0 ? "▲" : "▼"} ${Math.abs(off).toFixed(2)} m too ${off > 0 ? "far" : "near"}`;
  $("error-range").textContent = !valid ? "" : level === "bad" ? "Too near: go back" : level === "warn" ? "Near: no closer" : setpoint ? way : "";
  const aim = setpoint ? setpoint.yaw_deg : 0;
  const turn = Number(posture.yaw_deg) - aim;
  const there = Math.abs(turn) < ON_YAW;
  const degrees = `${Math.abs(turn).toFixed(Math.abs(turn) < 10 ? 1 : 0)}°`;
  $("turn").textContent = !valid ? "–" : there ? "✓" : turn > 0 ? `${degrees} ▶` : `◀ ${degrees}`;
  $("error-yaw").textContent = !valid ? "" : there ? (aim ? "on yaw" : "square to the target") : `turn ${turn > 0 ? "right" : "left"}`;
  $("aim-yaw").textContent = !valid ? "" : aim ? `for a yaw of ${signed(aim)}°` : there ? "" : "to stand square";
  $("box-range").dataset.level = valid ? level : "";
  $("box-turn").dataset.level = valid && there ? "ok" : "";
  $("vehicle").hidden = !vehicle;
  if (!vehicle) return;
  const known = (value, digits) => (stale || value === null ? "–" : value.toFixed(digits));
  $("depth").textContent = known(vehicle.depth_m, 2);
  $("heading").textContent = known(vehicle.heading_deg, 0).replace(/^\d+$/, (digits) => digits.padStart(3, "0"));
}

const signed = (value) => (value < 0 ? "−" : "+") + Math.abs(value).toFixed(1);

function health(stale) {
  const found = state.health;
  // Without pictures nobody knows how the lasers are; without news, how anything is.
  const blind = document.body.dataset.dead === "1";
  const chip = (part, name, unknown) => {
    const item = document.createElement("li");
    item.dataset.state = unknown ? "off" : part.state;
    item.title = unknown ? `${name}: not known now` : `${name}: ${part.state}. ${part.detail}`;
    const words = unknown || part.state === "ok" || !part.detail ? "" : `: ${part.detail}`;
    item.textContent = `${name}${words}`;
    return item;
  };
  const laser = (part) => (/laser/i.test(part.name) ? part.name : `laser ${part.name}`);
  const items = [
    chip(found.source, found.source.name, stale),
    ...found.lasers.map((part) => chip(part, laser(part), blind)),
    ...found.outputs.map((part) => chip(part, part.name, stale)),
  ];
  $("parts").replaceChildren(...items);
  const total = found.delays_ms.total;
  const delay = total ? `, delay ${total[0].toFixed(0)} ms` : "";
  $("rates").title = total ? `delay: ${total[0].toFixed(1)} ms, 99 % below ${total[1].toFixed(1)} ms` : "";
  $("rates").textContent = `${found.rate_hz.toFixed(0)} frames/s${delay}, ${found.n_dropped} skipped, ${found.n_lost} lost`;
}

function commands() {
  const { recording, setpoint } = state;
  $("record").setAttribute("aria-pressed", String(Boolean(recording.on)));
  $("record").textContent = recording.on ? "Stop recording" : "Record";
  const disk = recording.free_bytes === undefined ? "" : `, disk: ${size(recording.free_bytes)} free${recording.left_s === null ? "" : `, for ${lasting(recording.left_s)}`}`;
  const since = recording.seconds === undefined ? "" : `${clock(recording.seconds)} – `;
  $("record-words").textContent = `${since}${recording.words || ""}${disk}`;
  const verb = rig.holds ? "Holding" : "Aim:";
  $("set-words").textContent = setpoint ? `${verb} ${setpoint.range_m.toFixed(2)} m, ${setpoint.yaw_deg.toFixed(1)}°` : rig.holds ? "No setpoint" : "No aim";
}

const clock = (s) => `${Math.floor(s / 60)}:${String(Math.floor(s % 60)).padStart(2, "0")}`;
const size = (bytes) => (bytes < 1e9 ? `${(bytes / 1e6).toFixed(0)} MB` : `${(bytes / 1e9).toFixed(bytes < 1e10 ? 1 : 0)} GB`);
const lasting = (s) => (s < 5400 ? `${Math.floor(s / 60)} min` : `${Math.floor(s / 3600)} h`);

$("record").onclick = () => {
  answer("");
  say({ kind: "record", on: $("record").getAttribute("aria-pressed") !== "true" });
};
$("setpoint").onsubmit = (event) => {
  event.preventDefault();
  answer("");
  say({ kind: "setpoint", range_m: Number($("set-range").value), yaw_deg: Number($("set-yaw").value) });
};
$("set-clear").onclick = () => say({ kind: "setpoint", range_m: null });
$("ask").onsubmit = (event) => {
  event.preventDefault();
  sessionStorage.setItem("token", $("token").value);
  $("ask").hidden = true;
  connect();
};
function theme(dark) {
  document.documentElement.dataset.theme = dark ? "dark" : "light";
  $("theme").textContent = dark ? "Light" : "Dark";
  Object.values(strips).forEach((strip) => strip.redraw());
  dirty = true;
}
$("theme").onclick = () => theme(document.documentElement.dataset.theme !== "dark");
theme(matchMedia("(prefers-color-scheme: dark)").matches);

connect();
draw();
