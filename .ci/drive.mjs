// The checks of .ci/drive: node drive.mjs FOLDER. FOLDER holds person.glb, lit.glb, person.vrm, small.vrm,
// person.bvh, again.bvh and node/node_modules.
import { readFileSync } from "node:fs";
import { createRequire } from "node:module";
import path from "node:path";
import { pathToFileURL } from "node:url";

const folder = process.argv[2];
const at = (...parts) => path.join(folder, ...parts);
const require = createRequire(at("node/package.json"));
const load = (name) => import(pathToFileURL(at("node/node_modules", name)));
let failures = 0;

function check(holds, what) {
  console.log(`${holds ? "ok     " : "FAILED "} ${what}`);
  if (!holds) failures += 1;
}

for (const name of ["person.glb", "lit.glb", "person.vrm", "small.vrm"]) {
  const bytes = readFileSync(at(name));
  const { issues } = await require("gltf-validator").validateBytes(new Uint8Array(bytes));
  issues.messages.filter((m) => m.severity < 2).slice(0, 4).forEach((m) => console.log(`        ${m.code} ${m.pointer}: ${m.message}`));
  check(issues.numErrors + issues.numWarnings === 0, `${name}, ${(bytes.length * 1e-6).toFixed(2)} MB: ${issues.numErrors} errors, ${issues.numWarnings} warnings`);
}
check(readFileSync(at("small.vrm")).length <= 1e6, "small.vrm has at most 1 MB");

// Pictures are not decoded: Node has no canvas.
globalThis.self = globalThis;
globalThis.ProgressEvent ??= class {};
globalThis.createImageBitmap = async () => ({ width: 1, height: 1, close() {} });
const THREE = await import(pathToFileURL(require.resolve("three")));
const { GLTFLoader } = await load("three/examples/jsm/loaders/GLTFLoader.js");
const { BVHLoader } = await load("three/examples/jsm/loaders/BVHLoader.js");
const { VRMLoaderPlugin } = await load("@pixiv/three-vrm/lib/three-vrm.module.js");
const REQUIRED = ["hips", "spine", "head", ...["left", "right"].flatMap((side) =>
  ["UpperLeg", "LowerLeg", "Foot", "UpperArm", "LowerArm", "Hand"].map((bone) => side + bone))];
for (const name of ["person.vrm", "small.vrm"]) {
  const loader = new GLTFLoader();
  loader.register((parser) => new VRMLoaderPlugin(parser));
  const bytes = readFileSync(at(name));
  const gltf = await loader.parseAsync(bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.length), "");
  const { vrm } = gltf.userData;
  const missing = REQUIRED.filter((bone) => !vrm?.humanoid?.getRawBoneNode(bone));
  check(vrm && missing.length === 0, `three-vrm loads ${name}: "${vrm?.meta.name}" under ${vrm?.meta.licenseUrl}, missing bones: ${missing.join(", ") || "none"}`);
  gltf.scene.updateMatrixWorld(true);
  const place = (bone) => vrm.humanoid.getRawBoneNode(bone).getWorldPosition(new THREE.Vector3());
  const [left, right, hand, shoulder] = ["leftLowerArm", "rightLowerArm", "leftHand", "leftUpperArm"].map(place);
  check(left.x > 0.2 && right.x < -0.2 && Math.abs(hand.y - shoulder.y) < 1e-3, `it faces +z in a T-pose: the arm's ends are ${(1e3 * Math.abs(hand.y - shoulder.y)).toFixed(1)} mm apart in height`);
  // The elbow of the normalised rig moves that of the skin.
  vrm.humanoid.getNormalizedBoneNode("leftLowerArm").rotation.z = 1;
  vrm.update(0.1);
  gltf.scene.updateMatrixWorld(true);
  check(place("leftHand").distanceTo(hand) > 0.1, "a rotated elbow moves the hand");
  const mixer = new THREE.AnimationMixer(gltf.scene);
  mixer.clipAction(gltf.animations[0]).play();
  mixer.setTime(gltf.animations[0].duration / 2);
  gltf.scene.updateMatrixWorld(true);
  check(Number.isFinite(place("hips").y), `it plays ${gltf.animations[0].duration.toFixed(1)} s of motion`);
}

// Joints of the GLB and of both BVH at the same times, all by three.js, in metres.
const glb = readFileSync(at("person.glb"));
const gltf = await new GLTFLoader().parseAsync(glb.buffer.slice(glb.byteOffset, glb.byteOffset + glb.length), "");
const player = (root, clip) => {
  const mixer = new THREE.AnimationMixer(root);
  mixer.clipAction(clip).play();
  return (time) => { mixer.setTime(time); root.updateMatrixWorld(true); };
};
const reference = player(gltf.scene, gltf.animations[0]);
for (const name of ["person.bvh", "again.bvh"]) {
  const { skeleton, clip } = new BVHLoader().parse(readFileSync(at(name), "utf8"));
  const play = player(skeleton.bones[0], clip);
  const frames = gltf.animations[0].tracks[0].times;
  let worst = 0;
  for (let i = 0; i + 1 < frames.length; i++) {
    reference(frames[i]);
    play(i * clip.duration / (frames.length - 1));
    for (const bone of skeleton.bones.filter((bone) => bone.name !== "ENDSITE")) {
      const own = gltf.scene.getObjectByName(bone.name);
      const a = bone.getWorldPosition(new THREE.Vector3()).multiplyScalar(0.01);
      worst = Math.max(worst, a.distanceTo(own.getWorldPosition(new THREE.Vector3())));
    }
  }
  check(worst <= 1e-4, `three.js reads ${name}: joints within ${(1e3 * worst).toFixed(3)} mm of the GLB's over ${frames.length} frames`);
}
process.exit(failures ? 1 : 0);
