// Drawing with WebGL 2: the skinned shells, and lines for the floor and the cameras.

const SKINNED = `#version 300 es
layout(location = 0) in vec3 position;
layout(location = 1) in vec2 uv;
layout(location = 2) in uvec4 joints;
layout(location = 3) in vec4 weights;
layout(location = 4) in vec3 normal;
// Three rows a joint; what every device has room for is 256 joints.
layout(std140) uniform Bones { vec4 bones[768]; };
uniform mat4 camera;
uniform vec3 light;
out vec3 at;
void main() {
  // Rows of the blended bone.
  vec4 x = vec4(0.0), y = vec4(0.0), z = vec4(0.0);
  for (int i = 0; i < 4; i++) {
    int row = 3 * int(joints[i]);
    x += weights[i] * bones[row];
    y += weights[i] * bones[row + 1];
    z += weights[i] * bones[row + 2];
  }
  vec4 rest = vec4(position, 1.0);
  gl_Position = camera * vec4(dot(x, rest), dot(y, rest), dot(z, rest), 1.0);
  vec3 turned = vec3(dot(x.xyz, normal), dot(y.xyz, normal), dot(z.xyz, normal));
  float lamp = length(light);
  float along = dot(light, turned) * inversesqrt(max(dot(turned, turned), 1e-12)) / max(lamp, 1e-12);
  // As brightness is in training: black would say nothing of the colour.
  at = vec3(uv, max(1.0 + lamp * (along + 0.5 * (along * along - 1.0 / 3.0)), 0.2));
}`;
const TEXTURED = `#version 300 es
precision mediump float;
in highp vec3 at;
uniform sampler2D atlas;
uniform sampler2D confidence;
uniform float shown;
uniform float opaque;
out vec4 color;
void main() {
  vec4 texel = texture(atlas, at.xy);
  vec3 lit = texel.rgb * at.z;
  if (shown > 0.0) lit = mix(vec3(0.93, 0.45, 0.1), lit, 0.25 + 0.75 * texture(confidence, at.xy).r);
  color = vec4(lit, max(texel.a, opaque));
}`;
const LINE = `#version 300 es
layout(location = 0) in vec3 position;
layout(location = 1) in vec4 tint;
uniform mat4 camera;
out vec4 shade;
void main() {
  gl_Position = camera * vec4(position, 1.0);
  shade = tint;
}`;
const TINTED = `#version 300 es
precision mediump float;
in vec4 shade;
out vec4 color;
void main() { color = shade; }`;

class Scene {
  // `light`: where the lamp is, and by how much of the mean it lights.
  constructor(canvas, person, light) {
    const gl = canvas.getContext("webgl2", { antialias: false, alpha: false });
    if (!gl) throw new Error("This browser has no WebGL 2.");
    this.gl = gl;
    this.person = person;
    this.light = light;
    this.skinned = program(gl, SKINNED, TEXTURED);
    this.plain = program(gl, LINE, TINTED);
    this.surface = gl.createVertexArray();
    gl.bindVertexArray(this.surface);
    attribute(gl, 0, person.positions, 3, gl.FLOAT);
    attribute(gl, 1, person.uvs, 2, gl.FLOAT);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, person.joints, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(2);
    gl.vertexAttribIPointer(2, 4, gl.UNSIGNED_BYTE, 0, 0);
    attribute(gl, 3, person.weights, 4, gl.UNSIGNED_SHORT, true);
    attribute(gl, 4, person.normals, 3, gl.FLOAT);
    const upload = (indices) => {
      const buffer = gl.createBuffer();
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, buffer);
      gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, indices, gl.STATIC_DRAW);
      return { buffer, count: indices.length, type: indices instanceof Uint16Array ? gl.UNSIGNED_SHORT : gl.UNSIGNED_INT };
    };
    this.shells = person.shells.map((indices) => [upload(indices), upload(merged(indices))]);
    this.segments = gl.createVertexArray();
    this.lineBuffer = gl.createBuffer();
    gl.bindVertexArray(this.segments);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.lineBuffer);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 28, 0);
    gl.enableVertexAttribArray(1);
    gl.vertexAttribPointer(1, 4, gl.FLOAT, false, 28, 12);
    gl.bindVertexArray(null);
    this.bones = gl.createBuffer();
    gl.bindBufferBase(gl.UNIFORM_BUFFER, 0, this.bones);
    gl.bufferData(gl.UNIFORM_BUFFER, 768 * 16, gl.DYNAMIC_DRAW);
    gl.uniformBlockBinding(this.skinned.id, gl.getUniformBlockIndex(this.skinned.id, "Bones"), 0);
    this.atlas = texture(gl, gl.LINEAR);
    this.confidence = texture(gl, gl.LINEAR);
  }

  paint(atlas, confidence) {
    const gl = this.gl;
    gl.pixelStorei(gl.UNPACK_PREMULTIPLY_ALPHA_WEBGL, false);
    gl.pixelStorei(gl.UNPACK_COLORSPACE_CONVERSION_WEBGL, gl.NONE);
    gl.bindTexture(gl.TEXTURE_2D, this.atlas);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, atlas);
    gl.bindTexture(gl.TEXTURE_2D, this.confidence);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, confidence);
  }

  // `ground` and the lines' colours are [r, g, b, a] from 0 to 1; `segments` 7 numbers a line end;
  // `simple` draws a quarter of the triangles, where there are such.
  draw(camera, ground, segments, marksConfidence, simple) {
    const gl = this.gl;
    gl.viewport(0, 0, gl.drawingBufferWidth, gl.drawingBufferHeight);
    gl.clearColor(...ground);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);

    gl.useProgram(this.skinned.id);
    gl.bindBuffer(gl.UNIFORM_BUFFER, this.bones);
    gl.bufferSubData(gl.UNIFORM_BUFFER, 0, this.person.bones);
    gl.activeTexture(gl.TEXTURE1);
    gl.bindTexture(gl.TEXTURE_2D, this.atlas);
    gl.activeTexture(gl.TEXTURE2);
    gl.bindTexture(gl.TEXTURE_2D, this.confidence);
    gl.activeTexture(gl.TEXTURE0);
    gl.uniform1i(this.skinned.at("atlas"), 1);
    gl.uniform1i(this.skinned.at("confidence"), 2);
    gl.uniform1f(this.skinned.at("shown"), marksConfidence ? 1 : 0);
    gl.uniformMatrix4fv(this.skinned.at("camera"), false, camera);
    gl.uniform3fv(this.skinned.at("light"), this.light);
    gl.bindVertexArray(this.surface);
    gl.enable(gl.CULL_FACE);
    this.shells.forEach((levels, at) => {
      const shell = levels[simple ? 1 : 0];
      // The innermost is opaque, the others lie over it in order.
      gl.uniform1f(this.skinned.at("opaque"), at === 0 ? 1 : 0);
      if (at === 0) gl.disable(gl.BLEND);
      else gl.enable(gl.BLEND);
      gl.depthMask(at === 0);
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, shell.buffer);
      gl.drawElements(gl.TRIANGLES, shell.count, shell.type, 0);
    });
    gl.disable(gl.CULL_FACE);
    gl.depthMask(true);

    gl.useProgram(this.plain.id);
    gl.uniformMatrix4fv(this.plain.at("camera"), false, camera);
    gl.bindVertexArray(this.segments);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.lineBuffer);
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(segments), gl.DYNAMIC_DRAW);
    gl.enable(gl.BLEND);
    gl.drawArrays(gl.LINES, 0, segments.length / 7);
    gl.disable(gl.BLEND);
    gl.bindVertexArray(null);
  }
}

// Each four triangles that one was divided into as that one; as they are where they are something
// else.
function merged(indices) {
  if (indices.length % 12) return indices;
  const out = new indices.constructor(indices.length / 4);
  for (let i = 0; i < out.length; i += 3) {
    const [a, ab, ca, ab2, b, bc, ca2, bc2, c, ab3, bc3, ca3] = indices.subarray(4 * i, 4 * i + 12);
    if (ab !== ab2 || ab !== ab3 || bc !== bc2 || bc !== bc3 || ca !== ca2 || ca !== ca3) return indices;
    out.set([a, b, c], i);
  }
  return out;
}

function program(gl, vertex, fragment) {
  const id = gl.createProgram();
  for (const [type, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(id, shader);
  }
  gl.linkProgram(id);
  if (!gl.getProgramParameter(id, gl.LINK_STATUS) && !gl.isContextLost()) {
    throw new Error("The graphics driver refuses the drawing program: " + gl.getProgramInfoLog(id));
  }
  const places = {};
  return { id, at: (name) => places[name] || (places[name] = gl.getUniformLocation(id, name)) };
}

function attribute(gl, place, values, width, type, normalised = false) {
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
  gl.enableVertexAttribArray(place);
  gl.vertexAttribPointer(place, width, type, normalised, 0, 0);
}

function texture(gl, filter) {
  const id = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, id);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 1, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array([160, 160, 160, 255]));
  for (const [key, value] of [
    [gl.TEXTURE_MIN_FILTER, filter], [gl.TEXTURE_MAG_FILTER, filter],
    [gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE], [gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE],
  ]) gl.texParameteri(gl.TEXTURE_2D, key, value);
  return id;
}
