// The page: what is shown from where, and what keys, pointers and buttons change.

const element = (id) => document.getElementById(id);
const FIELD = (32 * Math.PI) / 180;
const NEAR = 0.05;
const FAR = 200;
// Pixels across each of the window's in a still picture.
const FINEST = 2;

class Page {
  constructor(person, extra) {
    this.person = person;
    this.cameras = extra.cameras;
    this.canvas = element("view");
    this.scene = new Scene(this.canvas, person, extra.light);
    this.clip = null;
    this.frame = 0;
    this.playing = false;
    this.stale = true;
    this.before = 0;
    // Pixels across each of the window's while something moves: fewer where the machine is too
    // slow. More than one smooths edges; multisampling costs software renderers most of a picture's
    // time.
    this.detail = FINEST;
    // Fewer triangles too, where fewer pixels were not enough.
    this.simple = false;
    this.touched = -Infinity;
    this.coarse = false;
    this.pace = 16;
    this.late = 0;
    const [low, high] = person.heights(1);
    this.height = Math.max(high - low, 1e-3);
    this.floor = low;
    this.hips = person.rest[0][1] - low;
    this.yaw = 0.5;
    this.pitch = 0.12;
    this.zoom = 1;
    this.fillChoices();
    this.listen();
    this.choose(person.clips.length ? 0 : -1);
    if (!matchMedia("(prefers-reduced-motion: reduce)").matches) this.play(this.clip !== null);
    requestAnimationFrame((now) => this.tick(now));
  }

  fillChoices() {
    const names = this.person.clips.map((clip) => clip.name).concat(["T-pose"]);
    names.forEach((name, at) => {
      const option = document.createElement("option");
      option.textContent = name;
      option.value = at < this.person.clips.length ? at : -1;
      element("clip").append(option);
    });
    for (const id of ["cameras", "through"]) element(id).parentElement.hidden = !this.cameras.length;
    this.frusta = [...new Map(this.cameras.map((camera) => [JSON.stringify(camera), camera])).values()];
  }

  // Clip `at`, or the rest pose for -1.
  choose(at) {
    this.clip = at < 0 ? null : this.person.clips[at];
    if (at >= 0) this.lastClip = at;
    element("clip").value = at;
    element("timeline").hidden = !this.clip;
    element("scrub").max = this.clip ? this.clip.times.length - 1 : 0;
    // The floor is under the lowest foot of the whole motion.
    this.floor = Infinity;
    const frames = this.clip ? this.clip.times.length : 1;
    const stride = Math.ceil(this.person.positions.length / 3 / 400);
    for (let i = 0; i < Math.min(frames, 24); i++) {
      this.person.pose(this.clip, Math.floor((i * frames) / Math.min(frames, 24)));
      this.floor = Math.min(this.floor, this.person.heights(stride)[0]);
    }
    if (!this.clip) this.play(false);
    this.seek(0);
  }

  seek(frame) {
    const last = this.clip ? this.clip.times.length - 1 : 0;
    this.frame = Math.min(Math.max(frame, 0), last);
    element("scrub").value = Math.round(this.frame);
    if (this.clip) {
      const seconds = this.clip.times[Math.round(this.frame)];
      element("clock").value = `${seconds.toFixed(1)} s · ${Math.round(this.frame)}`;
    }
    this.stale = true;
  }

  play(on) {
    this.playing = on && this.clip !== null;
    element("play").setAttribute("aria-label", this.playing ? "Pause" : "Play");
    element("icon").setAttribute("d", this.playing ? "M3 2h4v12H3zM9 2h4v12H9z" : "M4 2l10 6-10 6z");
    this.stale = true;
  }

  front() {
    const root = this.person.frames[0];
    this.yaw = Math.atan2(root[8], root[10]);
    this.pitch = 0.05;
    this.zoom = 1;
    element("through").checked = false;
    this.stale = true;
  }

  turn(yaw, pitch) {
    this.yaw += yaw;
    this.pitch = Math.min(Math.max(this.pitch + pitch, -1.5), 1.5);
    this.touched = performance.now();
    element("through").checked = false;
    this.stale = true;
  }

  magnify(factor) {
    this.zoom = Math.min(Math.max(this.zoom * factor, 0.2), 12);
    this.touched = performance.now();
    element("through").checked = false;
    this.stale = true;
  }

  listen() {
    element("play").onclick = () => this.play(!this.playing);
    element("scrub").oninput = (event) => {
      this.play(false);
      this.seek(Number(event.target.value));
    };
    element("clip").onchange = (event) => this.choose(Number(event.target.value));
    for (const id of ["confidence", "cameras", "through"]) element(id).onchange = () => (this.stale = true);
    element("front").onclick = () => this.front();
    element("keys").onclick = () => element("help").showModal();
    new ResizeObserver(() => (this.stale = true)).observe(this.canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => (this.stale = true));
    this.canvas.addEventListener("webglcontextlost", (event) => {
      event.preventDefault();
      say("The graphics were lost. Load the page again.");
    });
    this.point();
    document.addEventListener("keydown", (event) => this.key(event));
  }

  // One pointer turns, two zoom.
  point() {
    const down = new Map();
    const apart = () => {
      const [a, b] = [...down.values()];
      return Math.hypot(a.x - b.x, a.y - b.y);
    };
    const canvas = this.canvas;
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      down.set(event.pointerId, { x: event.clientX, y: event.clientY });
    });
    canvas.addEventListener("pointermove", (event) => {
      const from = down.get(event.pointerId);
      if (!from) return;
      const to = { x: event.clientX, y: event.clientY };
      if (down.size === 1) this.turn((from.x - to.x) * 0.008, (to.y - from.y) * 0.008);
      const before = down.size === 2 ? apart() : 0;
      down.set(event.pointerId, to);
      if (before > 0) this.magnify(apart() / before);
    });
    for (const name of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(name, (event) => down.delete(event.pointerId));
    }
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.magnify(Math.exp(-Math.sign(event.deltaY) * Math.min(Math.abs(event.deltaY), 100) * 0.0015));
    }, { passive: false });
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || element("help").open) return;
    const typing = event.target.matches("select");
    const pressed = event.target.matches("button, input[type=checkbox]") && event.key === " ";
    const toggle = (id) => {
      if (!element(id).parentElement.hidden) element(id).checked = !element(id).checked;
      this.stale = true;
    };
    const step = (by) => {
      this.play(false);
      this.seek(Math.round(this.frame) + by);
    };
    const actions = {
      " ": () => this.play(!this.playing), ArrowLeft: () => step(-1), ArrowRight: () => step(1),
      a: () => this.turn(-0.12, 0), d: () => this.turn(0.12, 0), w: () => this.turn(0, 0.12), s: () => this.turn(0, -0.12),
      "+": () => this.magnify(1.15), "=": () => this.magnify(1.15), "-": () => this.magnify(1 / 1.15),
      t: () => this.choose(this.clip ? -1 : this.lastClip ?? -1), c: () => toggle("confidence"),
      k: () => toggle("cameras"), v: () => toggle("through"), r: () => this.front(), "?": () => element("help").showModal(),
    };
    const action = actions[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (!action || typing || pressed) return;
    event.preventDefault();
    action();
  }

  tick(now) {
    if (this.playing) {
      const times = this.clip.times;
      const last = times.length - 1;
      const rate = last > 0 ? last / (times[last] - times[0]) : 0;
      const next = this.frame + Math.min((now - this.before) / 1000, 0.25) * rate;
      this.seek(next > last ? 0 : next);
    }
    this.adapt(Math.min(now - this.before, 100));
    this.before = now;
    if (this.stale) this.draw();
    requestAnimationFrame((later) => this.tick(later));
  }

  // Whether the next picture follows soon, so that this one need not be fine.
  moving() {
    return this.playing || performance.now() - this.touched < 200;
  }

  adapt(elapsed) {
    if (this.coarse && !this.moving()) this.stale = true;
    if (!this.playing) return;
    this.pace += 0.1 * (elapsed - this.pace);
    this.late = this.pace > 22 ? this.late + 1 : 0;
    if (this.late > 6 && !this.simple) {
      this.simple = this.detail === 0.5;
      this.detail = Math.max(0.5, this.detail * Math.max(Math.sqrt(16 / this.pace), 0.5));
      this.late = 0;
      this.pace = 16;
    }
  }

  draw() {
    this.stale = false;
    this.coarse = this.moving() && this.detail < FINEST;
    const dense = this.coarse ? this.detail : FINEST;
    const [width, height] = [this.canvas.clientWidth, this.canvas.clientHeight].map((n) => Math.max(Math.round(n * dense), 1));
    if (this.canvas.width !== width || this.canvas.height !== height) {
      this.canvas.width = width;
      this.canvas.height = height;
    }
    this.person.pose(this.clip, this.frame);
    const camera = element("through").checked && this.cameras.length
      ? this.cameraOfFrame(width, height) : this.orbit(width, height);
    const style = getComputedStyle(document.documentElement);
    const color = (name) => rgb(style.getPropertyValue(name).trim());
    const segments = this.floorLines(color("--line"));
    if (element("cameras").checked) segments.push(...this.cameraLines(color("--faint"), color("--accent")));
    this.scene.draw(camera, color("--ground"), segments, element("confidence").checked,
      this.coarse && this.simple);
  }

  orbit(width, height) {
    const root = this.person.root();
    // In the middle of what the panel leaves free.
    const covered = document.querySelector("footer").offsetHeight / Math.max(this.canvas.clientHeight, 1);
    // Half of a jump is followed, so that both the floor and the head stay in the picture.
    const rise = 0.5 * (root[1] - this.floor - this.hips);
    const target = [root[0], this.floor + 0.5 * this.height + rise, root[2]];
    const aspect = width / height;
    let reach = Math.max((0.56 * this.height) / Math.max(1 - covered, 0.3), ((this.clip ? 0.4 : 0.56) * this.height) / aspect);
    if (element("cameras").checked) {
      const away = this.shownCameras().map((camera) => Math.hypot(...eyeOf(camera).map((x, i) => x - target[i])));
      reach = Math.max(reach, (0.65 * Math.max(...away, 0)) / Math.min(aspect, 1));
    }
    const distance = reach / Math.tan(FIELD / 2) / this.zoom;
    const [sy, cy, sp, cp] = [Math.sin(this.yaw), Math.cos(this.yaw), Math.sin(this.pitch), Math.cos(this.pitch)];
    const back = [sy * cp, sp, cy * cp];
    const right = [cy, 0, -sy];
    const up = [-sy * sp, cp, -cy * sp];
    const eye = target.map((x, i) => x + distance * back[i]);
    const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    const view = new Float32Array([
      right[0], up[0], back[0], 0, right[1], up[1], back[1], 0, right[2], up[2], back[2], 0,
      -dot(right, eye), -dot(up, eye), -dot(back, eye), 1,
    ]);
    const f = 1 / Math.tan(FIELD / 2);
    const depth = NEAR - FAR;
    const lens = new Float32Array([
      f / aspect, 0, 0, 0, 0, f, 0, 0, 0, -covered, (FAR + NEAR) / depth, -1, 0, 0, (2 * FAR * NEAR) / depth, 0,
    ]);
    return multiply(lens, view);
  }

  // The training camera's whole picture, as large as the window allows.
  cameraOfFrame(width, height) {
    const { k, size, e } = this.cameras[Math.min(Math.round(this.frame), this.cameras.length - 1)];
    const scale = 2 * Math.min(width / size[0], height / size[1]);
    const [sx, sy] = [scale / width, scale / height];
    const depth = FAR - NEAR;
    const lens = new Float32Array([
      sx * k[0], 0, 0, 0, 0, -sy * k[1], 0, 0,
      sx * (k[2] - size[0] / 2), -sy * (k[3] - size[1] / 2), (FAR + NEAR) / depth, 1, 0, 0, (-2 * FAR * NEAR) / depth, 0,
    ]);
    const view = new Float32Array(16);
    for (let i = 0; i < 12; i++) view[4 * (i % 4) + Math.floor(i / 4)] = e[i];
    view[15] = 1;
    return multiply(lens, view);
  }

  floorLines(color) {
    const root = this.person.root();
    const [x0, z0] = [Math.round(2 * root[0]) / 2, Math.round(2 * root[2]) / 2];
    const lines = [];
    const cell = 0.5;
    const half = 4;
    for (let i = -half; i <= half; i++) {
      for (const [a, b] of [[[i, -half], [i, half]], [[-half, i], [half, i]]]) {
        for (const [x, z] of [a, b]) lines.push(x0 + cell * x, this.floor, z0 + cell * z, ...color);
      }
    }
    return lines;
  }

  // A hundred cameras are enough to see the path of one that moves.
  shownCameras() {
    const stride = Math.ceil(this.frusta.length / 100);
    return this.frusta.filter((_, at) => at % stride === 0);
  }

  // Each camera as a pyramid, that of the shown frame in the accent's colour.
  cameraLines(faint, accent) {
    const current = this.cameras[Math.min(Math.round(this.frame), this.cameras.length - 1)];
    const lines = [];
    const shown = this.shownCameras();
    if (this.clip === this.person.clips[0]) shown.push(current);
    for (const camera of shown) {
      const { k, size } = camera;
      const world = (x, y, z) => toWorld(camera, x, y, z);
      const far = 0.3;
      const corner = (u, v) => world(((u - k[2]) / k[0]) * far, ((v - k[3]) / k[1]) * far, far);
      const eye = eyeOf(camera);
      const corners = [corner(0, 0), corner(size[0], 0), corner(size[0], size[1]), corner(0, size[1])];
      const color = camera === current && this.clip === this.person.clips[0] ? accent : faint;
      corners.forEach((at, i) => {
        for (const [a, b] of [[eye, at], [at, corners[(i + 1) % 4]]]) lines.push(...a, ...color, ...b, ...color);
      });
    }
    return lines;
  }
}

// A point of a camera's own axes in the world.
function toWorld({ e }, x, y, z) {
  const d = [x - e[3], y - e[7], z - e[11]];
  return [0, 1, 2].map((i) => e[i] * d[0] + e[4 + i] * d[1] + e[8 + i] * d[2]);
}

const eyeOf = (camera) => toWorld(camera, 0, 0, 0);

function rgb(hex) {
  const part = (at) => parseInt(hex.slice(at, at + 2), 16) / 255;
  return [part(1), part(3), part(5), 1];
}

function say(text) {
  element("message").textContent = text;
  element("message").hidden = false;
}

async function start() {
  const extra = JSON.parse(element("extra").textContent);
  const person = new Person(bytesOf(element("avatar").textContent));
  const picture = (blob) => createImageBitmap(blob, { premultiplyAlpha: "none", colorSpaceConversion: "none" });
  const confidence = new Blob([bytesOf(extra.confidence)], { type: "image/png" });
  // Before the first drawing, which would show a grey person.
  const textures = await Promise.all([picture(person.picture()), picture(confidence)]);
  new Page(person, extra).scene.paint(...textures);
  document.documentElement.dataset.ready = "true";
}

start().catch((error) => say(String(error.message || error)));
