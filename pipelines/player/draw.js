// Draws splats: one point each, cut to its ellipse by the fragment shader, blended from far to near.
//
// Points, not instanced quads: software WebGL takes a microsecond for each primitive, whatever its size, and far
// more for each instance. Sorting is by counting, on the page's own thread: two milliseconds for 60 000 splats.
// Static splats behind all that moves are kept in a picture of their own while the camera stands still.

const VERTEX = `#version 300 es
layout(location = 0) in vec3 place;
layout(location = 1) in uint id;
uniform highp sampler2D shapes, turns;
uniform mat3 turn;
uniform vec3 shift;
uniform vec2 focal, centre, size, largest;
uniform float guard;
flat out vec4 colour;
flat out vec4 ellipse;

void main() {
  int at = int(id & OWN) * 2, part = int(id / (OWN + 1u));
  vec4 a = texelFetch(shapes, ivec2(at & 1023, at >> 10), 0);
  vec4 b = texelFetch(shapes, ivec2((at + 1) & 1023, at >> 10), 0);
  mat3 spread = mat3(a.x, a.y, a.z, a.y, a.w, b.x, a.z, b.x, b.y);
  vec3 seen = turn * place + shift;
  vec2 ray = clamp(seen.xy / seen.z, -largest, largest);
  mat3 slope = mat3(focal.x, 0, 0, 0, focal.y, 0, -ray.x * focal.x, -ray.y * focal.y, 0) * turn;
  if (part > 0) {
    vec4 x = texelFetch(turns, ivec2(0, part), 0), y = texelFetch(turns, ivec2(1, part), 0);
    slope = slope * transpose(mat3(x.xyz, y.xyz, texelFetch(turns, ivec2(2, part), 0).xyz));
  }
  mat3 flat_spread = slope * spread * transpose(slope);
  float z2 = seen.z * seen.z;
  float uu = flat_spread[0][0] / z2 + BLUR, vv = flat_spread[1][1] / z2 + BLUR, uv = flat_spread[0][1] / z2;
  float area = uu * vv - uv * uv;
  float packed = b.z, opacity = b.w;
  colour = vec4(mod(floor(packed / vec3(65536, 256, 1)), 256.0) / 255.0, opacity);
  float reach = sqrt(2.0 * log(max(opacity * 255.0, 1.0)) * max(uu, vv));
  gl_PointSize = min(2.0 * reach + 1.0, largest_point);
  ellipse = vec4(vec3(vv, -uv, uu) / area * 0.5, gl_PointSize);
  vec2 pixel = seen.xy / seen.z * focal + centre;
  gl_Position = vec4((pixel - size * 0.5) * vec2(2, -2) / (size + 2.0 * guard), 0, 1);
}`;

const FRAGMENT = `#version 300 es
precision highp float;
flat in vec4 colour;
flat in vec4 ellipse;
out vec4 light;

void main() {
  vec2 d = (gl_PointCoord - 0.5) * ellipse.w;
  float alpha = colour.a * exp(-(ellipse.x * d.x * d.x + 2.0 * ellipse.y * d.x * d.y + ellipse.z * d.y * d.y));
  if (alpha < 1.0 / 255.0) discard;
  alpha = min(alpha, 0.99);
  light = vec4(colour.rgb * alpha, alpha);
}`;

const BLUR = "0.3"; // square pixels, as the splats were fitted with
const GUARD = 96; // pixels around the picture: points whose middle is outside would be dropped whole
const NEAREST = 0.05; // box units
const OWN = (1 << 21) - 1; // bits of a splat's number; those above are of the node it is on
const DEPTHS = 1 << 14; // steps of depth that are told apart

export class Drawing {
  constructor(canvas, splats, behind) {
    this.gl = canvas.getContext("webgl2", { antialias: false, powerPreference: "high-performance" });
    if (!this.gl) throw new Error("no WebGL2");
    this.canvas = canvas;
    this.splats = splats;
    this.behind = behind;
    this.keys = new Uint16Array(splats.count);
    this.order = new Uint32Array(splats.count);
    this.vertices = new ArrayBuffer(16 * splats.count);
    this.build();
  }

  build() {
    const gl = this.gl;
    const largest = gl.getParameter(gl.ALIASED_POINT_SIZE_RANGE)[1].toFixed(1);
    const vertex = VERTEX.replaceAll("BLUR", BLUR).replaceAll("OWN", `${OWN}u`).replaceAll("largest_point", largest);
    const program = (this.program = gl.createProgram());
    for (const [type, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(type);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
      const shaders = gl.getAttachedShaders(program).map((shader) => gl.getShaderInfoLog(shader));
      throw new Error(shaders.join("\n") + gl.getProgramInfoLog(program));
    }
    gl.useProgram(program);
    this.at = (name) => gl.getUniformLocation(program, name);
    const rows = Math.ceil((2 * this.splats.count) / 1024);
    const shapes = new Float32Array(4096 * rows);
    shapes.set(this.splats.shapes);
    ["shapes", "turns"].forEach((name, unit) => {
      gl.uniform1i(this.at(name), unit);
      gl.activeTexture(gl.TEXTURE0 + unit); // the last one stays, `draw` fills it
      gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
      for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, side, gl.NEAREST);
      if (!unit) gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, 1024, rows, 0, gl.RGBA, gl.FLOAT, shapes);
    });
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, this.vertices.byteLength, gl.DYNAMIC_DRAW);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 16, 0);
    gl.enableVertexAttribArray(1);
    gl.vertexAttribIPointer(1, 1, gl.UNSIGNED_INT, 16, 12);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    [this.frame, this.buffer] = [gl.createFramebuffer(), gl.createRenderbuffer()];
    this.kept = null;
  }

  // One picture: `view` has turn (row by row), shift, focal, centre; `places` are at the present time.
  draw(view, places) {
    const gl = this.gl, { width, height } = this.canvas;
    if (gl.isContextLost()) return 0;
    gl.uniformMatrix3fv(this.at("turn"), true, view.turn);
    gl.uniform3fv(this.at("shift"), view.shift);
    gl.uniform2fv(this.at("focal"), view.focal);
    gl.uniform2fv(this.at("centre"), view.centre);
    gl.uniform2f(this.at("size"), width, height);
    gl.uniform1f(this.at("guard"), GUARD);
    gl.uniform2f(this.at("largest"), (0.65 * width) / view.focal[0], (0.65 * height) / view.focal[1]);
    const { turns } = this.splats;
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, 3, turns.length / 12, 0, gl.RGBA, gl.FLOAT, turns);
    const key = [...view.turn, ...view.shift, ...view.focal, ...view.centre, width, height].join();
    const from = this.splats.moving ? this.farthest(view) : 0;
    let drawn = 0;
    if (this.kept !== key) {
      this.fit(width, height);
      gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame);
      gl.clearColor(...this.behind, 1);
      gl.clear(gl.COLOR_BUFFER_BIT);
      drawn += this.layer(view, places, from, Infinity);
      this.kept = key;
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.clear(gl.COLOR_BUFFER_BIT); // Chromium clears a shown canvas before it is drawn on, but not before a blit
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, this.frame);
    gl.blitFramebuffer(0, 0, width, height, 0, 0, width, height, gl.COLOR_BUFFER_BIT, gl.NEAREST);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    if (from > 0) drawn += this.layer(view, places, 0, from);
    return drawn;
  }

  // The greatest depth that anything that moves ever has.
  farthest(view) {
    const [lo, hi] = this.splats.swept, [, , , , , , x, y, z] = view.turn;
    return view.shift[2] + [x, y, z].reduce((sum, way, axis) => sum + way * (way > 0 ? hi : lo)[axis], 0);
  }

  // Sorts and draws the splats of a range of depths.
  layer(view, places, from, to) {
    const gl = this.gl;
    const count = this.sort(view, places, from, to);
    gl.viewport(-GUARD, -GUARD, this.canvas.width + 2 * GUARD, this.canvas.height + 2 * GUARD);
    gl.bufferSubData(gl.ARRAY_BUFFER, 0, new Uint8Array(this.vertices, 0, 16 * count));
    gl.drawArrays(gl.POINTS, 0, count);
    return count;
  }

  // Fills `vertices` with what is in view between two depths, from far to near; returns how many.
  sort(view, places, from, to) {
    const { keys, order } = this, { radii, count, parts } = this.splats;
    const [xx, xy, xz, yx, yy, yz, zx, zy, zz] = view.turn, [sx, sy, sz] = view.shift;
    const across = (0.5 * this.canvas.width) / view.focal[0], down = (0.5 * this.canvas.height) / view.focal[1];
    const aside = (view.centre[0] - 0.5 * this.canvas.width) / view.focal[0];
    const below = (view.centre[1] - 0.5 * this.canvas.height) / view.focal[1];
    const last = Math.min(to, this.splats.reach(view.shift)), near = Math.max(from, NEAREST);
    const scale = (DEPTHS - 1) / Math.log(Math.max(last, 2 * near) / near);
    const starts = new Uint32Array(DEPTHS + 1);
    let found = 0;
    for (let n = 0, k = 0; n < count; n++, k += 3) {
      const px = places[k], py = places[k + 1], pz = places[k + 2];
      const z = zx * px + zy * py + zz * pz + sz;
      if (z < near || z >= to) continue;
      const x = xx * px + xy * py + xz * pz + sx + aside * z, y = yx * px + yy * py + yz * pz + sy + below * z;
      const r = radii[n];
      if (Math.abs(x) > across * z + r || Math.abs(y) > down * z + r) continue;
      const key = DEPTHS - 1 - Math.min(DEPTHS - 1, (scale * Math.log(z / near)) | 0);
      keys[found] = key;
      order[found++] = n;
      starts[key + 1]++;
    }
    for (let key = 0; key < DEPTHS; key++) starts[key + 1] += starts[key];
    const floats = new Float32Array(this.vertices), ids = new Uint32Array(this.vertices);
    for (let n = 0; n < found; n++) {
      const at = 4 * starts[keys[n]]++, id = order[n], k = 3 * id;
      floats[at] = places[k];
      floats[at + 1] = places[k + 1];
      floats[at + 2] = places[k + 2];
      ids[at + 3] = id + (OWN + 1) * parts[id];
    }
    return found;
  }

  // The picture in which what is behind everything that moves is kept.
  fit(width, height) {
    const gl = this.gl;
    gl.bindRenderbuffer(gl.RENDERBUFFER, this.buffer);
    gl.renderbufferStorage(gl.RENDERBUFFER, gl.RGBA8, width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame);
    gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.RENDERBUFFER, this.buffer);
  }
}
