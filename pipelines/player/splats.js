// Unpacks the page's splats (reconstruct/splats/packed.py says how they are packed) and moves them in time.

export class Splats {
  // `about` is what the page says of them, `bytes` what it carries.
  constructor(about, bytes) {
    const { count, moving, keys } = about;
    Object.assign(this, { count, moving, keys, step: about.step });
    let at = 0;
    const words = (n) => {
      const low = bytes.subarray(at, at + n), high = bytes.subarray(at + n, (at += 2 * n));
      return Uint16Array.from({ length: n }, (_, k) => low[k] | (high[k] << 8));
    };
    const take = (n) => bytes.subarray(at, (at += n));
    this.places = new Float32Array(bytes.slice(at, (at += 12 * count)).buffer);
    const quats = take(4 * count), scales = take(3 * count), opacities = take(count), colours = take(3 * count);
    this.ways = Array.from({ length: Math.max(0, keys - 1) }, () => new Int16Array(words(3 * moving).buffer));
    this.radii = new Float32Array(count);
    this.shapes = this.unpackShapes(about.scales, quats, scales, opacities, colours);
    this.unpackWays();
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
      let [w, x, y, z] = [0, 1, 2, 3].map((part) => quats[4 * n + part] - 128);
      const length = Math.hypot(w, x, y, z) || 1;
      w /= length, x /= length, y /= length, z /= length;
      const R = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
      ];
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
    const a = this.moved[first], b = this.moved[first + 1], places = this.places;
    for (let k = 0; k < a.length; k++) places[k] = a[k] + share * (b[k] - a[k]);
    return places;
  }

  // No splat is deeper than this in a camera that stands so far from the origin.
  reach(shift) {
    return this.farthest + Math.hypot(...shift);
  }
}

// The bytes that a page carries in base 64, deflated.
export async function unpack(text) {
  const packed = Uint8Array.from(atob(text.trim()), (letter) => letter.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}
