// Unpacks the page's splats (reconstruct/splats/packed.py says how they are packed) and moves them in time.

export class Splats {
  // `about` is what the page says of them, `bytes` what it carries.
  constructor(about, bytes) {
    const { count, moving, keys, nodes = 0, step, swept } = about;
    Object.assign(this, { count, moving, keys, nodes, step, swept });
    let at = 0;
    const words = (n) => {
      const low = bytes.subarray(at, at + n), high = bytes.subarray(at + n, (at += 2 * n));
      return Uint16Array.from({ length: n }, (_, k) => low[k] | (high[k] << 8));
    };
    const take = (n) => bytes.subarray(at, (at += n));
    this.places = new Float32Array(bytes.slice(at, (at += 12 * count)).buffer);
    const quats = take(4 * count), scales = take(3 * count), opacities = take(count), colours = take(3 * count);
    this.parts = new Uint8Array(count); // the node that each is on; 0: none
    this.turns = new Float32Array(12 * (nodes + 1)); // of the nodes now, rows of three texels
    if (nodes) {
      this.parts.set(take(moving));
      this.courses = new Float32Array(bytes.slice(at, (at += 28 * nodes * keys)).buffer);
      this.own = this.places.slice(0, 3 * moving);
      this.onNodes(0, 0);
    } else {
      this.ways = Array.from({ length: Math.max(0, keys - 1) }, () => new Int16Array(words(3 * moving).buffer));
      this.unpackWays();
    }
    this.radii = new Float32Array(count);
    this.shapes = this.unpackShapes(about.scales, quats, scales, opacities, colours);
    this.farthest = 0;
    for (let n = 0; n < 3 * count; n += 3) {
      const [x, y, z] = this.places.subarray(n, n + 3);
      this.farthest = Math.max(this.farthest, x * x + y * y + z * z);
    }
    this.farthest = Math.sqrt(this.farthest);
  }

  // Covariances, colours and opacities, two texels each.
  unpackShapes([lowest, highest], quats, scales, opacities, colours) {
    const shapes = new Float32Array(8 * this.count);
    for (let n = 0; n < this.count; n++) {
      const [w, x, y, z] = [0, 1, 2, 3].map((part) => quats[4 * n + part] - 128);
      const R = rotation(w, x, y, z);
      const s = [0, 1, 2].map((axis) => Math.exp(lowest + ((highest - lowest) * scales[3 * n + axis]) / 255));
      const spread = (i, j) =>
        [0, 1, 2].reduce((sum, axis) => sum + R[3 * i + axis] * R[3 * j + axis] * s[axis] * s[axis], 0);
      const rgb = colours[3 * n] * 65536 + colours[3 * n + 1] * 256 + colours[3 * n + 2];
      const six = [spread(0, 0), spread(0, 1), spread(0, 2), spread(1, 1), spread(1, 2), spread(2, 2)];
      shapes.set([...six, rgb, opacities[n] / 255], 8 * n);
      this.radii[n] = 3.4 * Math.max(...s);
    }
    return shapes;
  }

  // Places of what moves at the key times, and the box that it sweeps.
  unpackWays() {
    const first = this.places.slice(0, 3 * this.moving), now = new Int32Array(3 * this.moving);
    this.swept = [[Infinity, Infinity, Infinity], [-Infinity, -Infinity, -Infinity]];
    this.moved = [];
    for (let key = 0; key < this.keys; key++) {
      if (key) this.ways[key - 1].forEach((way, k) => (now[k] += way));
      const places = Float32Array.from(now, (steps, k) => first[k] + this.step * steps);
      places.forEach((value, k) => {
        this.swept[0][k % 3] = Math.min(this.swept[0][k % 3], value);
        this.swept[1][k % 3] = Math.max(this.swept[1][k % 3], value);
      });
      this.moved.push(places);
    }
    this.ways = null;
  }

  // Places at a time, in seconds as `times` has them for the keys: blended between the two around it.
  at(time, times) {
    if (!this.moving || this.keys < 2) return this.places;
    let first = 0;
    while (first < this.keys - 2 && times[first + 1] <= time) first++;
    const share = Math.max(0, Math.min(1, (time - times[first]) / (times[first + 1] - times[first])));
    if (this.nodes) return this.onNodes(first, share);
    const a = this.moved[first], b = this.moved[first + 1], places = this.places;
    for (let k = 0; k < a.length; k++) places[k] = a[k] + share * (b[k] - a[k]);
    return places;
  }

  // The same on nodes, which go straight and turn along the arc between key times.
  onNodes(first, share) {
    const { parts, places, own, nodes, courses, turns } = this, next = Math.min(first + 1, this.keys - 1);
    const shifts = new Float32Array(3 * (nodes + 1));
    for (let n = 0; n < nodes; n++) {
      const [a, b] = [first, next].map((key) => courses.subarray(7 * (key * nodes + n)));
      const cosine = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3], arc = Math.acos(Math.min(1, Math.abs(cosine)));
      const [here, there] = arc < 1e-3 ? [1 - share, share] : [Math.sin((1 - share) * arc), Math.sin(share * arc)];
      const R = rotation(...[0, 1, 2, 3].map((k) => here * a[k] + Math.sign(cosine) * there * b[k]));
      for (let row = 0; row < 3; row++) {
        turns.set(R.slice(3 * row, 3 * row + 3), 12 * (n + 1) + 4 * row);
        shifts[3 * (n + 1) + row] = a[4 + row] + share * (b[4 + row] - a[4 + row]);
      }
    }
    for (let n = 0, k = 0; n < this.moving; n++, k += 3) {
      const part = parts[n], x = own[k], y = own[k + 1], z = own[k + 2];
      for (let row = 0, at = 12 * part; row < 3; row++, at += 4)
        places[k + row] = turns[at] * x + turns[at + 1] * y + turns[at + 2] * z + shifts[3 * part + row];
    }
    return places;
  }

  // No splat is deeper than this in a camera that stands so far from the origin.
  reach(shift) {
    return this.farthest + Math.hypot(...shift);
  }
}

// The matrix of a quaternion of any length, row by row.
function rotation(w, x, y, z) {
  const length = Math.hypot(w, x, y, z) || 1;
  w /= length, x /= length, y /= length, z /= length;
  return [
    1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
    2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
    2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
  ];
}

// The bytes that a page carries in base 64, deflated.
export async function unpack(text) {
  const packed = Uint8Array.from(atob(text.trim()), (letter) => letter.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}
