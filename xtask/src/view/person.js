// The avatar: read from binary glTF, and posed.

function bytesOf(base64) {
  const text = atob(base64.trim());
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return bytes;
}

// Matrices are 4 × 4, column-major.
function multiply(a, b) {
  const out = new Float32Array(16);
  for (let c = 0; c < 4; c++) {
    for (let r = 0; r < 4; r++) {
      let sum = 0;
      for (let k = 0; k < 4; k++) sum += a[4 * k + r] * b[4 * c + k];
      out[4 * c + r] = sum;
    }
  }
  return out;
}

function placed([x, y, z, w], t) {
  return new Float32Array([
    1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y), 0,
    2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x), 0,
    2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y), 0,
    t[0], t[1], t[2], 1,
  ]);
}

class Person {
  constructor(bytes) {
    const view = new DataView(bytes.buffer);
    const length = view.getUint32(12, true);
    this.json = JSON.parse(new TextDecoder().decode(bytes.subarray(20, 20 + length)));
    this.binary = bytes.subarray(28 + length);
    const primitives = this.json.meshes[0].primitives;
    const attributes = primitives[0].attributes;
    this.positions = this.array(attributes.POSITION);
    this.normals = this.array(attributes.NORMAL);
    this.uvs = this.array(attributes.TEXCOORD_0);
    this.joints = this.array(attributes.JOINTS_0);
    this.weights = this.array(attributes.WEIGHTS_0);
    this.shells = primitives.map((primitive) => this.array(primitive.indices));
    this.inverseBind = this.array(this.json.skins[0].inverseBindMatrices);
    const nodes = this.json.skins[0].joints.map((node) => this.json.nodes[node]);
    this.rest = nodes.map((node) => node.translation);
    this.parents = nodes.map(() => -1);
    nodes.forEach((node, at) => (node.children || []).forEach((child) => (this.parents[child] = at)));
    this.clips = (this.json.animations || []).map((animation) => this.clip(animation));
    this.bones = new Float32Array(12 * nodes.length);
    this.pose(null, 0);
  }

  array(index) {
    const accessor = this.json.accessors[index];
    const view = this.json.bufferViews[accessor.bufferView];
    const types = { 5121: Uint8Array, 5123: Uint16Array, 5125: Uint32Array, 5126: Float32Array };
    const widths = { SCALAR: 1, VEC2: 2, VEC3: 3, VEC4: 4, MAT4: 16 };
    const start = this.binary.byteOffset + view.byteOffset;
    const whole = this.binary.buffer.slice(start, start + view.byteLength);
    return new types[accessor.componentType](whole, 0, accessor.count * widths[accessor.type]);
  }

  picture() {
    const { bufferView, mimeType } = this.json.images[0];
    const view = this.json.bufferViews[bufferView];
    return new Blob([this.binary.subarray(view.byteOffset, view.byteOffset + view.byteLength)], { type: mimeType });
  }

  clip(animation) {
    const clip = { name: animation.name, turns: [], times: null, places: null };
    for (const { sampler, target } of animation.channels) {
      const { input, output } = animation.samplers[sampler];
      clip.times = this.array(input);
      if (target.path === "rotation") clip.turns[target.node] = this.array(output);
      else clip.places = this.array(output);
    }
    return clip;
  }

  // Joints at `frame` of a clip, a fraction being between two; the rest pose without a clip.
  pose(clip, frame) {
    const last = clip ? clip.times.length - 1 : 0;
    const first = Math.min(Math.max(Math.floor(frame), 0), last);
    const second = Math.min(first + 1, last);
    const share = Math.min(Math.max(frame - first, 0), 1);
    this.frames = this.rest.map((rest, joint) => 0);
    for (let joint = 0; joint < this.rest.length; joint++) {
      let place = this.rest[joint];
      let turn = [0, 0, 0, 1];
      if (clip) {
        const turns = clip.turns[joint];
        if (turns) turn = between(turns, first, second, share);
        if (joint === 0 && clip.places) {
          place = [0, 1, 2].map((i) => clip.places[3 * first + i] * (1 - share) + clip.places[3 * second + i] * share);
        }
      }
      const local = placed(turn, place);
      const parent = this.parents[joint];
      this.frames[joint] = parent < 0 ? local : multiply(this.frames[parent], local);
      const bone = multiply(this.frames[joint], this.inverseBind.subarray(16 * joint, 16 * joint + 16));
      for (let row = 0; row < 3; row++) {
        for (let column = 0; column < 4; column++) this.bones[12 * joint + 4 * row + column] = bone[4 * column + row];
      }
    }
  }

  root() {
    return this.frames[0].slice(12, 15);
  }

  // Lowest and highest of every `stride`-th vertex as posed.
  heights(stride) {
    let low = Infinity;
    let high = -Infinity;
    for (let v = 0; v < this.positions.length / 3; v += stride) {
      let y = 0;
      for (let i = 0; i < 4; i++) {
        const weight = this.weights[4 * v + i] / 65535;
        const row = 12 * this.joints[4 * v + i] + 4;
        const at = this.bones[row] * this.positions[3 * v] + this.bones[row + 1] * this.positions[3 * v + 1];
        y += weight * (at + this.bones[row + 2] * this.positions[3 * v + 2] + this.bones[row + 3]);
      }
      low = Math.min(low, y);
      high = Math.max(high, y);
    }
    return [low, high];
  }
}

// Spherical interpolation; neighbouring keys are in one hemisphere.
function between(turns, first, second, share) {
  const a = turns.subarray(4 * first, 4 * first + 4);
  const b = turns.subarray(4 * second, 4 * second + 4);
  const cosine = Math.min(a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3], 1);
  const angle = Math.acos(cosine);
  const [p, q] = angle < 1e-4
    ? [1 - share, share]
    : [Math.sin((1 - share) * angle) / Math.sin(angle), Math.sin(share * angle) / Math.sin(angle)];
  const out = [0, 1, 2, 3].map((i) => p * a[i] + q * b[i]);
  const length = Math.hypot(...out) || 1;
  return out.map((x) => x / length);
}
