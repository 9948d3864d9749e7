"use strict";
// Numbers come as server-sent events, the picture as an MJPEG <img>; both stop while nobody looks at the tab.
const LONGEST_S = 60, SHORTEST_S = 15, STALE_MS = 3000;
const at = (id) => document.getElementById(id);
let stream = null, points = [], limits = {}, heard = 0, blind = false, drawn = 0, times = [];

const put = (id, text) => { const e = at(id); if (e.textContent !== text) e.textContent = text; };
const number = (v, digits, unit) => (v === null || v === undefined ? "–" : v.toFixed(digits) + unit);

function connect() {
  if (stream) stream.close();
  stream = new EventSource("events");
  stream.addEventListener("start", (event) => {
    const first = JSON.parse(event.data);
    points = first.history;
    limits = first.limits;
    put("title", first.title);
    put("version", first.version);
    charts();
  });
  stream.onmessage = (event) => { heard = Date.now(); show(JSON.parse(event.data)); };
}

function show(state) {
  const record = state.record, service = state.service || {};
  const faults = new Set([...(record ? record.faults : []), ...(service.faults || [])]);
  put("faults", faults.size ? [...faults].join(", ") : "none");
  at("faults").className = faults.size ? "some" : "";
  put("status", service.status || "");
  blind = faults.has("blind") || [...faults].some((f) => f.startsWith("camera_"));
  if (!record) { if (blind) put("alert", "no picture"); return; }
  const lead = record.lead, level = record.alert.level;
  put("distance", lead && lead.distance_m !== null ? lead.distance_m.toFixed(1) + " m" : "–");
  put("sigma", lead ? (lead.sigma_m !== null ? "± " + lead.sigma_m.toFixed(2) + " m, by " + lead.source : "not calibrated") : "no vehicle ahead");
  put("ttc", lead ? number(lead.ttc_s, 1, " s") : "–");
  put("rate", lead ? number(lead.range_rate_mps, 1, " m/s") : "–");
  put("headway", lead ? number(lead.headway_s, 1, " s") : "–");
  put("speed", record.ego ? number(record.ego.speed_mps * 3.6, 0, " km/h") : "–");
  at("banner").className = level !== "none" ? level : blind ? "none" : "ok";
  put("alert", level === "none" ? (blind ? "no picture" : "no alert") : level.toUpperCase() + (record.alert.reason ? " (" + record.alert.reason + ")" : ""));
  if (record.t !== drawn) {
    if (record.t < drawn) points = [];
    drawn = record.t;
    points.push([record.t, lead && lead.distance_m, lead && lead.sigma_m, lead && lead.range_rate_mps, lead && lead.ttc_s, ["none", "caution", "warning"].indexOf(level)]);
    while (points.length && points[0][0] < record.t - LONGEST_S) points.shift();
    times.push(Date.now());
    while (times[0] < Date.now() - 3000) times.shift();
  }
  put("fps", (times.length / 3).toFixed(0) + " updates/s, " + number(record.timing_ms.total, 0, " ms a frame"));
  aim(state.aim || {});
  charts();
}

function aim(a) {
  const on = at("showaid").checked;
  at("aim").hidden = !on;
  at("aid").toggleAttribute("hidden", !on);
  document.querySelectorAll(".tag").forEach((e) => e.remove());
  if (!on || !a.zones) return;
  const shapes = [], tags = [], stage = at("stage");
  if (a.horizon) shapes.push(shape("line", { x1: a.horizon[0][0], y1: a.horizon[0][1], x2: a.horizon[1][0], y2: a.horizon[1][1] }));
  for (const z of a.zones) {
    const [left, top, right, bottom] = z.box;
    shapes.push(shape("rect", { x: left, y: top, width: right - left, height: bottom - top }));
    const x = Math.max(left, 0) * stage.clientWidth, y = top * stage.clientHeight;
    const free = tags.every((t) => Math.abs(t[0] - x) > 28 || Math.abs(t[1] - y) > 12);  // no tag over another on a phone
    if (free && top > 0.03 && top < 1 && left < 1) {
      tags.push([x, y]);
      const tag = document.createElement("span");
      tag.className = "tag";
      tag.textContent = z.distance_m + " m";
      tag.style.left = Math.max(left, 0) * 100 + "%";
      tag.style.top = top * 100 + "%";
      stage.append(tag);
    }
  }
  at("aid").replaceChildren(...shapes);
  put("advice", a.advice || "the aim is good");
  at("advice").className = a.advice ? "bad" : "good";
  at("focusbar").style.width = 100 * (a.focus_share || 0) + "%";
  put("focus", Math.round(100 * (a.focus_share || 0)) + " % (" + a.focus.toFixed(2) + ")");
  at("lightbar").style.width = a.exposure.mean / 2.55 + "%";
  put("light", a.exposure.word + (a.exposure.bright > 0.02 ? ", " + Math.round(100 * a.exposure.bright) + " % burnt" : ""));
  put("nominal", a.nominal ? " The camera is not calibrated: boxes and horizon are drawn for a common lens." : "");
}

function shape(name, values) {
  const e = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(values)) e.setAttribute(key, value);
  return e;
}

function charts() {
  chart("c-distance", "distance, m", 1, 2, {});
  chart("c-ttc", "TTC, s", 4, null, limits, 10);
}

function chart(id, label, column, sigma, lines, top) {
  const canvas = at(id), ratio = devicePixelRatio || 1, w = canvas.clientWidth, h = canvas.clientHeight;
  if (!w) return;
  if (canvas.width !== Math.round(w * ratio)) { canvas.width = Math.round(w * ratio); canvas.height = Math.round(h * ratio); }
  const c = canvas.getContext("2d"), left = 34, right = w - 6, up = 16, down = h - 16;
  c.setTransform(ratio, 0, 0, ratio, 0, 0);
  c.clearRect(0, 0, w, h);
  c.font = "11px system-ui, sans-serif";
  const end = points.length ? points[points.length - 1][0] : 0;
  const span = Math.min(LONGEST_S, Math.max(SHORTEST_S, points.length ? end - points[0][0] : 0));
  const values = points.map((p) => p[column]).filter((v) => v !== null && v !== undefined);
  const high = top || Math.max(5, ...values) * 1.1;
  const x = (t) => right - (end - t) / span * (right - left), y = (v) => down - Math.min(Math.max(v, 0), high) / high * (down - up);
  for (let k = 0, first = 0; k < points.length; k++) {  // one box a stretch of the same level: boxes side by side would show seams
    const level = points[first][5], last = k + 1 === points.length;
    if (!last && points[k + 1][5] === level) continue;
    const from = x(points[first][0]), to = x(points[last ? k : k + 1][0]);
    first = k + 1;
    if (!level) continue;
    c.fillStyle = level === 2 ? "#d83a3a44" : "#e09a1a44";
    c.fillRect(from, up, Math.max(to - from, 1), down - up);
  }
  c.strokeStyle = "#34404d"; c.fillStyle = "#9aa7b5"; c.lineWidth = 1; c.textAlign = "right";
  const step = [0.5, 1, 2, 5, 10, 20, 50, 100].find((s) => high / s <= 4) || 200;
  for (let v = 0; v <= high; v += step) {
    c.beginPath(); c.moveTo(left, y(v)); c.lineTo(right, y(v)); c.stroke();
    c.fillText(String(v), left - 4, y(v) + 4);
  }
  c.textAlign = "center";
  for (let s = 0; s <= span; s += span > 30 ? 15 : 5) c.fillText(s ? "-" + s + " s" : "now", Math.max(x(end - s), left + 10) - (s ? 0 : 10), h - 3);
  c.textAlign = "left";
  c.fillText(label, left + 2, 11);
  for (const [name, v] of Object.entries(lines)) {
    c.strokeStyle = name === "warning" ? "#d83a3a" : "#e09a1a"; c.setLineDash([5, 4]);
    c.beginPath(); c.moveTo(left, y(v)); c.lineTo(right, y(v)); c.stroke(); c.setLineDash([]);
  }
  const known = (p) => p[column] !== null && p[column] !== undefined && (!top || p[column] <= top);
  const runs = [];
  let run = null;
  for (const p of points) {
    if (!known(p) || (run && p[0] - run[run.length - 1][0] > 1)) run = null;
    if (known(p)) { if (!run) runs.push(run = []); run.push(p); }
  }
  for (const r of runs) {
    if (sigma) {
      c.fillStyle = "#5aa9ff44"; c.beginPath();
      r.forEach((p) => c.lineTo(x(p[0]), y(p[column] + 2 * (p[sigma] || 0))));
      [...r].reverse().forEach((p) => c.lineTo(x(p[0]), y(p[column] - 2 * (p[sigma] || 0))));
      c.fill();
    }
    c.strokeStyle = "#5aa9ff"; c.lineWidth = 1.6; c.beginPath();
    r.forEach((p, k) => (k ? c.lineTo(x(p[0]), y(p[column])) : c.moveTo(x(p[0]), y(p[column]))));
    c.stroke(); c.lineWidth = 1;
  }
}

function picture() {
  const wanted = at("showpicture").checked && !document.hidden;
  const video = at("video");
  if (wanted && !video.getAttribute("src")) video.src = "video?" + Date.now();
  if (!wanted && video.getAttribute("src")) video.removeAttribute("src");
}

at("video").addEventListener("load", () => (at("nothing").hidden = true));
at("video").addEventListener("error", () => {
  at("nothing").hidden = false;
  at("video").removeAttribute("src");
  setTimeout(picture, 2000);
});
at("showpicture").addEventListener("change", picture);
document.addEventListener("visibilitychange", () => {
  picture();
  if (document.hidden && stream) { stream.close(); stream = null; } else if (!document.hidden && !stream) connect();
});
addEventListener("resize", charts);
setInterval(() => {
  const stale = Date.now() - heard > STALE_MS;
  at("video").classList.toggle("stale", stale || blind);
  if (stale) { at("banner").className = "none"; put("alert", heard ? "no news" : "connecting"); }
}, 1000);
connect();
picture();
