// The page's half of the conversation: greet, show what comes, ask for what the pilot wants.
"use strict";

const $ = (id) => document.getElementById(id);
const strips = {
  range: new Strip($("strip-range"), "Range", "m", 0.05),
  yaw: new Strip($("strip-yaw"), "Yaw", "°", 4),
  pitch: new Strip($("strip-pitch"), "Pitch", "°", 4),
};
// After so long without news the numbers are old, whatever the last message said.
const STALE_MS = 600;
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
  else if (message.kind === "refused") $("answer").textContent = message.why;
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
    name.style.color = laser.colour;
    return name;
  });
  $("plane-names").replaceChildren(...names);
  const [near, far] = rig.working_range_m;
  Object.assign($("set-range"), { min: near, max: far, placeholder: `${near}–${far}` });
  for (const element of document.querySelectorAll("#commands button, #commands input")) element.disabled = !rig.may_command;
  $("answer").textContent = rig.may_command ? "" : "Open the page with its token to command.";
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
    health();
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
    $(id).textContent = valid ? (sign && value >= 0 ? "+" : "") + value.toFixed(digits) : "–";
  };
  put("range", posture.range_m, 3, false);
  put("yaw", posture.yaw_deg, 1, true);
  put("pitch", posture.pitch_deg, 1, true);
  $("sigma-range").textContent = valid ? `± ${(1000 * posture.sigma_range_total_m).toFixed(1)} mm` : "";
  $("sigma-yaw").textContent = valid ? `± ${Number(posture.sigma_yaw_total_deg).toFixed(2)}°` : "";
  $("sigma-pitch").textContent = valid ? `± ${Number(posture.sigma_pitch_total_deg).toFixed(2)}°` : "";
  const words = stale ? "no news from the system" : state.detail || posture.reason;
  $("reason").textContent = valid ? "" : `No posture: ${words}`;
  const dead = stale || posture.reason === "no_frames" || posture.reason === "frozen";
  document.body.dataset.dead = dead ? "1" : "0";
  $("veil").hidden = !dead;
  $("veil").textContent = dead ? words : "";
  $("n-water").textContent = state.n_water;
  $("n-sigma").textContent = state.health.sigma_n_water === null ? "" : `± ${state.health.sigma_n_water.toFixed(4)}`;
  const smooth = stale ? null : state.filtered;
  $("smooth").textContent = smooth ? `Filtered: ${smooth.range_m.toFixed(3)} m, yaw ${smooth.yaw_deg.toFixed(1)}°, pitch ${smooth.pitch_deg.toFixed(1)}°` : "";
}

function health() {
  const found = state.health;
  const items = [found.source, ...found.lasers, ...found.outputs].map((part) => {
    const item = document.createElement("li");
    item.dataset.state = part.state;
    item.title = `${part.name}: ${part.state}. ${part.detail}`;
    const words = part.state === "ok" || !part.detail ? "" : `: ${part.detail}`;
    item.textContent = `${part.name}${words}`;
    return item;
  });
  $("parts").replaceChildren(...items);
  const total = found.delays_ms.total;
  const delay = total ? `, delay ${total[0].toFixed(1)} ms (99 %: ${total[1].toFixed(1)})` : "";
  $("rates").textContent = `${found.rate_hz.toFixed(0)} Hz${delay}, ${found.n_dropped} skipped, ${found.n_lost} lost`;
}

function commands() {
  const { recording, setpoint } = state;
  $("record").setAttribute("aria-pressed", String(Boolean(recording.on)));
  $("record").textContent = recording.on ? "Stop recording" : "Record";
  $("record-words").textContent = recording.words || "";
  $("set-words").textContent = setpoint ? `Setpoint ${setpoint.range_m.toFixed(2)} m, ${setpoint.yaw_deg.toFixed(1)}°` : "No setpoint";
}

$("record").onclick = () => {
  $("answer").textContent = "";
  say({ kind: "record", on: $("record").getAttribute("aria-pressed") !== "true" });
};
$("setpoint").onsubmit = (event) => {
  event.preventDefault();
  $("answer").textContent = "";
  say({ kind: "setpoint", range_m: Number($("set-range").value), yaw_deg: Number($("set-yaw").value) });
};
$("set-clear").onclick = () => say({ kind: "setpoint", range_m: null });
$("ask").onsubmit = (event) => {
  event.preventDefault();
  sessionStorage.setItem("token", $("token").value);
  $("ask").hidden = true;
  connect();
};
$("theme").onclick = () => {
  const dark = document.documentElement.dataset.theme !== "dark";
  document.documentElement.dataset.theme = dark ? "dark" : "light";
  $("theme").textContent = dark ? "Light" : "Dark";
  dirty = true;
};

connect();
draw();
