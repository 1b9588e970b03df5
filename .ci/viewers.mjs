// The checks of .ci/viewers: node viewers.mjs FOLDER CHROMIUM. FOLDER holds person.glb, person.ply,
// person.html, movement/ (pictures 0000.png … of every frame on white, and movement.mp4) and
// node/node_modules.
import { execFileSync } from "node:child_process";
import { existsSync, readFileSync, readdirSync, writeFileSync } from "node:fs";
import { createRequire } from "node:module";
import path from "node:path";

const [folder, browserPath] = process.argv.slice(2);
const require = createRequire(path.join(folder, "node/package.json"));
const { chromium } = require("playwright-core");
const at = (...parts) => path.join(folder, ...parts);
let failures = 0;

function check(holds, what) {
  console.log(`${holds ? "ok     " : "FAILED "} ${what}`);
  if (!holds) failures += 1;
}

async function validate() {
  const report = await require("gltf-validator").validateBytes(new Uint8Array(readFileSync(at("person.glb"))));
  const { numErrors, numWarnings, numInfos, numHints, messages } = report.issues;
  messages.slice(0, 8).forEach((m) => console.log(`         ${m.code} ${m.pointer}: ${m.message}`));
  check(numErrors === 0 && numWarnings === 0,
    `Khronos validator: ${numErrors} errors, ${numWarnings} warnings, ${numInfos} infos, ${numHints} hints`);
  const size = readFileSync(at("person.glb")).length;
  check(size <= 8e6, `GLB has ${(size * 1e-6).toFixed(2)} MB of 8`);
}

// Pages of http://local/ come from FOLDER; everything else that is asked for is written down.
async function open(browser, options, address) {
  const context = await browser.newContext(options);
  const page = await context.newPage();
  const problems = [];
  const requests = [];
  page.on("console", (message) => message.type() === "error" && problems.push(message.text()));
  page.on("pageerror", (error) => problems.push(String(error)));
  page.on("request", (request) => {
    if (!/^(data|blob):/.test(request.url()) && request.url() !== address) requests.push(request.url());
  });
  await context.route("http://local/**", (route) => {
    const file = at(decodeURIComponent(new URL(route.request().url()).pathname));
    const types = { ".html": "text/html", ".js": "text/javascript", ".mp4": "video/mp4", ".png": "image/png" };
    if (!existsSync(file)) return route.fulfill({ status: 404, body: "" });
    const type = types[path.extname(file)] || "application/octet-stream";
    return route.fulfill({ body: readFileSync(file), contentType: type });
  });
  await page.goto(address);
  return { page, problems, requests, close: () => context.close() };
}

// dB between two PNGs, of the whole picture and of the pixels that either paints; decoded by the
// browser.
function decibels(page, a, b) {
  return page.evaluate(async ([a, b]) => {
    const pixels = async (base64) => {
      const bytes = Uint8Array.from(atob(base64), (c) => c.charCodeAt(0));
      const bitmap = await createImageBitmap(new Blob([bytes], { type: "image/png" }));
      const context = new OffscreenCanvas(bitmap.width, bitmap.height).getContext("2d");
      context.fillStyle = "white";
      context.fillRect(0, 0, bitmap.width, bitmap.height);
      context.drawImage(bitmap, 0, 0);
      return context.getImageData(0, 0, bitmap.width, bitmap.height).data;
    };
    const [p, q] = [await pixels(a), await pixels(b)];
    if (p.length !== q.length) return { whole: -1, painted: -1, share: 0 };
    let [whole, painted, count] = [0, 0, 0];
    for (let i = 0; i < p.length; i += 4) {
      let error = 0;
      for (let c = 0; c < 3; c++) error += (p[i + c] - q[i + c]) ** 2 / 3;
      whole += error;
      if (Math.min(p[i], p[i + 1], p[i + 2], q[i], q[i + 1], q[i + 2]) < 250) {
        painted += error;
        count += 1;
      }
    }
    const db = (sum, n) => 10 * Math.log10((255 * 255 * Math.max(n, 1)) / Math.max(sum, 1e-9));
    return { whole: db(whole, p.length / 4), painted: db(painted, count), share: (4 * count) / p.length };
  }, [a.toString("base64"), b.toString("base64")]);
}

const text = ({ whole, painted, share }) =>
  `${whole.toFixed(2)} dB (${painted.toFixed(2)} dB on the ${(100 * share).toFixed(0)} % that either paints)`;

// A page that draws the person with three.js through a training camera: window.shot(frame, camera)
// → PNG.
const THREE_PAGE = (body) => `<!doctype html><meta charset="utf-8"><link rel="icon" href="data:,">
<script type="importmap">{"imports":{"three":"/node/node_modules/three/build/three.module.js",
"three/addons/":"/node/node_modules/three/examples/jsm/","spark":"/node/node_modules/@sparkjsdev/spark/dist/spark.module.js",
"splats-3d":"/node/node_modules/@mkkellogg/gaussian-splats-3d/build/gaussian-splats-3d.module.js",
"gsplat":"/node/node_modules/gsplat/dist/index.es.js"}}</script>
<script type="module">
import * as THREE from "three";
const renderer = new THREE.WebGLRenderer({ antialias: true, preserveDrawingBuffer: true });
renderer.setClearColor(0xffffff, 1);
document.body.append(renderer.domElement);
const scene = new THREE.Scene();
window.camera = ({ k, size, e }, side) => {
  const scale = side / Math.max(...size);
  const [w, h] = size.map((n) => Math.round(n * scale));
  renderer.setSize(w, h);
  const camera = new THREE.PerspectiveCamera();
  const [near, far] = [0.05, 100];
  // OpenCV's camera looks along +z with y down, three's along -z with y up.
  camera.projectionMatrix.set(
    (2 * k[0]) / size[0], 0, 1 - (2 * k[2]) / size[0], 0,
    0, (2 * k[1]) / size[1], (2 * k[3]) / size[1] - 1, 0,
    0, 0, -(far + near) / (far - near), (-2 * far * near) / (far - near),
    0, 0, -1, 0);
  camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
  const view = new THREE.Matrix4().set(e[0], e[1], e[2], e[3], -e[4], -e[5], -e[6], -e[7], -e[8], -e[9], -e[10], -e[11], 0, 0, 0, 1);
  camera.matrixAutoUpdate = false;
  camera.matrix.copy(view).invert();
  camera.matrix.decompose(camera.position, camera.quaternion, camera.scale);
  camera.updateMatrixWorld(true);
  return camera;
};
window.png = () => renderer.domElement.toDataURL("image/png").split(",")[1];
${body}
</script>`;

const GLB_BODY = `
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
const gltf = await new GLTFLoader().loadAsync("/person.glb");
scene.add(gltf.scene);
const mixer = new THREE.AnimationMixer(gltf.scene);
const action = mixer.clipAction(gltf.animations[0]);
// The last frame is not the first.
action.setLoop(THREE.LoopOnce);
action.clampWhenFinished = true;
action.play();
window.shot = (seconds, camera, side) => {
  action.reset();
  mixer.setTime(seconds);
  gltf.scene.traverse((o) => (o.frustumCulled = false));
  renderer.render(scene, window.camera(camera, side));
  return window.png();
};
window.ready = gltf.animations[0].tracks[0].times;`;

// Splat viewers by name. Such files have y down. Sorting is done beside drawing.
const SHOT = `
window.shot = async (camera, side) => {
  for (let i = 0; i < 4; i++) {
    renderer.render(scene, window.camera(camera, side));
    await new Promise((done) => setTimeout(done, 1000));
  }
  return window.png();
};`;
const SPLATS = {
  spark: `
import { SparkRenderer, SplatMesh } from "spark";
scene.add(new SparkRenderer({ renderer }));
const splats = new SplatMesh({ url: "/person.ply" });
await splats.initialized;
splats.rotation.x = Math.PI;
scene.add(splats);
${SHOT}
window.ready = splats.packedSplats?.numSplats ?? splats.numSplats;`,
  "gaussian-splats-3d": `
import { DropInViewer, SceneRevealMode } from "splats-3d";
const splats = new DropInViewer({ sharedMemoryForWorkers: false, gpuAcceleratedSort: false, sceneRevealMode: SceneRevealMode.Instant });
await splats.addSplatScene("/person.ply", { rotation: [1, 0, 0, 0], showLoadingUI: false });
scene.add(splats);
${SHOT}
window.ready = splats.splatMesh?.getSplatCount() ?? splats.viewer.splatMesh.getSplatCount();`,
  gsplat: `
import * as SPLAT from "gsplat";
const world = new SPLAT.Scene();
const splats = await SPLAT.PLYLoader.LoadAsync("/person.ply", world, () => {});
// Without passes that fade splats in.
const drawing = new SPLAT.WebGLRenderer(null, []);
document.body.append(drawing.canvas);
window.shot = async ({ k, size, e }, side) => {
  const scale = side / Math.max(...size);
  const [w, h] = size.map((n) => Math.round(n * scale));
  drawing.setSize(w, h);
  const eye = new SPLAT.Camera(new SPLAT.CameraData());
  [eye.data.fx, eye.data.fy] = [k[0] * scale, k[1] * scale];
  // Rotation and place of the camera in a world of y down: half a turn about x.
  const turn = new THREE.Matrix4().set(e[0], -e[1], -e[2], 0, e[4], -e[5], -e[6], 0, e[8], -e[9], -e[10], 0, 0, 0, 0, 1);
  turn.transpose();
  const at = new THREE.Vector3(-e[3], -e[7], -e[11]).applyMatrix4(turn);
  const q = new THREE.Quaternion().setFromRotationMatrix(turn);
  eye.position = new SPLAT.Vector3(at.x, at.y, at.z);
  eye.rotation = new SPLAT.Quaternion(q.x, q.y, q.z, q.w);
  eye.update();
  let png = "";
  for (let i = 0; i < 4; i++) {
    drawing.render(world, eye);
    png = drawing.canvas.toDataURL("image/png").split(",")[1];
    await new Promise((done) => setTimeout(done, 1000));
  }
  return png;
};
window.ready = splats.data.vertexCount;`,
};

async function shots(browser, cameras) {
  writeFileSync(at("three.html"), THREE_PAGE(GLB_BODY));
  const glb = await open(browser, { viewport: { width: 700, height: 700 } }, "http://local/three.html");
  await glb.page.waitForFunction(() => window.ready, null, { timeout: 60000 });
  const times = await glb.page.evaluate(() => Array.from(window.ready));
  const last = times.length - 1;
  const frames = [0, 1, 2, 3, 4].map((i) => Math.round((i * last) / 4));
  let worst = Infinity;
  for (const frame of frames) {
    const drawn = Buffer.from(await glb.page.evaluate(([t, c]) => window.shot(t, c, 512), [times[frame], cameras[frame]]), "base64");
    writeFileSync(at("pictures", `three-${frame}.png`), drawn);
    const ours = readFileSync(at("movement", `${String(frame).padStart(4, "0")}.png`));
    const difference = await decibels(glb.page, drawn, ours);
    worst = Math.min(worst, difference.whole);
    console.log(`         frame ${frame}: three.js against our drawing ${text(difference)}`);
  }
  check(worst >= 30, `three.js draws five frames as we do: at least ${worst.toFixed(2)} dB of 30`);
  check(glb.problems.length === 0, `three.js reports no errors ${glb.problems.slice(0, 3).join("; ")}`);
  await glb.close();

  for (const [viewer, body] of Object.entries(SPLATS)) {
    writeFileSync(at("splats.html"), THREE_PAGE(body));
    const splats = await open(browser, { viewport: { width: 700, height: 700 } }, "http://local/splats.html");
    await splats.page.waitForFunction(() => window.ready, null, { timeout: 60000 }).catch(() => {});
    const late = new Promise((done) => setTimeout(() => done(null), 240000));
    const drawn = await Promise.race([splats.page.evaluate((c) => window.shot?.(c, 512), cameras[0]), late]);
    check(Boolean(drawn), `${viewer} reads the PLY: ${await splats.page.evaluate(() => window.ready)} splats ${splats.problems.slice(0, 3).join("; ")}`);
    if (drawn) {
      const picture = Buffer.from(drawn, "base64");
      writeFileSync(at("pictures", `${viewer}.png`), picture);
      const difference = await decibels(splats.page, picture, readFileSync(at("movement/0000.png")));
      check(difference.whole >= 25, `and draws it as we do: ${text(difference)}, expected 25`);
    }
    await splats.close();
  }
}

async function video(browser) {
  const file = at("movement/movement.mp4");
  const pictures = readdirSync(at("movement")).filter((name) => /^\d{4}\.png$/.test(name)).sort();
  const fields = "stream=codec_name,width,height,nb_read_frames,r_frame_rate,pix_fmt";
  const probe = JSON.parse(execFileSync("ffprobe", ["-v", "error", "-count_frames", "-show_entries", fields, "-of", "json", file]));
  const stream = probe.streams[0];
  check(stream.codec_name === "h264" && Number(stream.nb_read_frames) === pictures.length,
    `ffprobe: ${stream.codec_name} ${stream.width}x${stream.height} ${stream.pix_fmt}, ${stream.nb_read_frames} of ${pictures.length} frames`);
  const rate = Number(stream.r_frame_rate.split("/")[0]) / Number(stream.r_frame_rate.split("/")[1]);
  writeFileSync(at("video.html"), `<!doctype html><link rel="icon" href="data:,"><video muted></video>`);
  const { page, problems, close } = await open(browser, {}, "http://local/video.html");
  const frame = Math.floor(pictures.length / 2);
  const shot = await page.evaluate(async (seconds) => {
    const video = document.querySelector("video");
    // Whole in memory, so that it can be sought in.
    const whole = await (await fetch("/movement/movement.mp4")).blob();
    await new Promise((done, fail) => {
      video.onloadeddata = done;
      video.onerror = () => fail(new Error(video.error.message));
      video.src = URL.createObjectURL(whole);
    });
    await new Promise((done) => { video.onseeked = done; video.currentTime = seconds; });
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [video.videoWidth, video.videoHeight];
    canvas.getContext("2d").drawImage(video, 0, 0);
    const first = video.currentTime;
    await video.play();
    await new Promise((done) => setTimeout(done, 500));
    return { png: canvas.toDataURL("image/png").split(",")[1], moved: video.currentTime !== first, duration: video.duration };
  }, (frame + 0.5) / rate).catch((error) => ({ error: String(error) }));
  check(!shot.error && shot.moved, `Chromium plays it: ${shot.error || `${shot.duration.toFixed(2)} s`} ${problems.join("; ")}`);
  if (shot.png) {
    const picture = Buffer.from(shot.png, "base64");
    writeFileSync(at("pictures", "video.png"), picture);
    const difference = await decibels(page, picture, readFileSync(at("movement", pictures[frame])));
    check(difference.whole >= 30, `frame ${frame} of the video against the picture: ${text(difference)}, expected 30`);
  }
  await close();
}

async function person(browser) {
  const size = readFileSync(at("person.html")).length;
  check(size < 10e6, `the page has ${(size * 1e-6).toFixed(2)} MB of 10`);
  const address = "file://" + at("person.html");
  for (const [width, height, colorScheme, touch] of [[390, 844, "dark", true], [1280, 800, "light", false]]) {
    const options = { viewport: { width, height }, colorScheme, hasTouch: touch, isMobile: touch };
    const { page, problems, requests, close } = await open(browser, options, address);
    await page.waitForSelector("html[data-ready]", { state: "attached", timeout: 30000 }).catch(() => {});
    const name = (what) => at("pictures", `page-${width}-${what}.png`);
    await page.waitForTimeout(2500);
    const drawn = await page.evaluate(async () => {
      let count = 0;
      const original = WebGL2RenderingContext.prototype.clear;
      WebGL2RenderingContext.prototype.clear = function (...a) { count += 1; return original.apply(this, a); };
      const start = performance.now();
      await new Promise((done) => setTimeout(done, 3000));
      WebGL2RenderingContext.prototype.clear = original;
      return (1000 * count) / (performance.now() - start);
    });
    const pixels = await page.evaluate(() => {
      const { width, height } = document.querySelector("canvas");
      return `${width} × ${height}`;
    });
    check(drawn >= 30, `${width} px: ${drawn.toFixed(1)} pictures a second of ${pixels} with software WebGL, expected 30`);
    await page.screenshot({ path: name("play") });
    await page.keyboard.press(" ");
    await page.evaluate(() => { const s = document.querySelector("#scrub"); s.value = 10; s.dispatchEvent(new Event("input")); });
    await page.waitForTimeout(400);
    const before = await page.screenshot({ path: name("before") });
    const [x, y] = [width / 2, height * 0.4];
    await page.mouse.move(x, y);
    await page.mouse.down();
    await page.mouse.move(x + 100, y + 5, { steps: 6 });
    await page.mouse.up();
    await page.waitForTimeout(400);
    const after = await page.screenshot({ path: name("after") });
    const turned = await decibels(page, before, after);
    check(turned.whole < 25, `${width} px: dragging turns the person (pictures before and after ${turned.whole.toFixed(1)} dB apart)`);
    await page.mouse.move(x + 100, y + 5);
    await page.mouse.down();
    await page.mouse.move(x, y, { steps: 6 });
    await page.mouse.up();
    await page.waitForTimeout(400);
    const back = await decibels(page, before, await page.screenshot());
    check(back.whole > 40, `${width} px: dragging back turns it back (${back.whole.toFixed(1)} dB)`);
    for (const [key, what] of [["c", "confidence"], ["k", "cameras"], ["v", "through"], ["v", "r"], ["t", "tpose"]]) {
      await page.keyboard.press(key);
      await page.waitForTimeout(300);
      await page.screenshot({ path: name(what) });
    }
    await page.keyboard.press("?");
    await page.waitForTimeout(200);
    await page.screenshot({ path: name("help") });
    const overflow = await page.evaluate(() => document.documentElement.scrollWidth - innerWidth);
    check(overflow <= 0, `${width} px: nothing is wider than the window`);
    check(problems.length === 0, `${width} px: no errors in the console ${problems.slice(0, 3).join("; ")}`);
    check(requests.length === 0, `${width} px: no request leaves the page ${requests.slice(0, 3).join(" ")}`);
    await close();
  }
}

await validate();
const args = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-quic",
  "--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync"];
const browser = await chromium.launch({ executablePath: browserPath, headless: true, args });
const html = readFileSync(at("person.html"), "utf8");
const cameras = JSON.parse(html.match(/<script id="extra"[^>]*>(.*?)<\/script>/s)[1]).cameras;
for (const part of [() => person(browser), () => shots(browser, cameras), () => video(browser)]) {
  await part().catch((error) => check(false, String(error).split("\n")[0]));
}
await browser.close();
process.exit(failures ? 1 : 0);
