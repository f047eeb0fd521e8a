// The camera: a pose in the splats' frame (x right, y down, z forward), turned about a point that it looks at.

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const plus = (a, b, share = 1) => a.map((value, k) => value + share * b[k]);
const unit = (a) => a.map((value) => value / Math.hypot(...a));
const STEEPEST = 0.995; // cosine to the scene's up axis beyond which the camera is not tilted
const CLOSEST = 0.02; // of the first distance
const FARTHEST = 8;

export class Orbit {
  // `views` have name, turn (rows: right, down, forward), eye, target and lens (focal, centre, size in pixels).
  constructor(views, up) {
    this.up = up;
    this.show(views[0]);
    this.first = this.distance;
  }

  // Exactly a view.
  show(view) {
    this.right = view.turn.slice(0, 3);
    this.down = view.turn.slice(3, 6);
    this.forward = view.turn.slice(6, 9);
    this.eye = [...view.eye];
    this.distance = Math.max(1e-3, dot(plus(view.target, view.eye, -1), this.forward));
    this.lens = view.lens;
  }

  get target() {
    return plus(this.eye, this.forward, this.distance);
  }

  // Turn about the target: around the scene's up axis, then up or down; radians.
  turn(across, over) {
    const target = this.target;
    this.rotate(this.up, across);
    const tilted = this.forward.map((f, k) => Math.cos(over) * f - Math.sin(over) * this.down[k]);
    if (Math.abs(dot(tilted, this.up)) < STEEPEST) this.rotate(this.right, over);
    this.eye = plus(target, this.forward, -this.distance);
  }

  // Shift picture and target; in parts of the picture's height.
  pan(across, down) {
    const width = (this.distance * this.lens.size[1]) / this.lens.focal[1];
    this.eye = plus(plus(this.eye, this.right, -across * width), this.down, -down * width);
  }

  zoom(factor) {
    const target = this.target;
    this.distance = Math.max(CLOSEST * this.first, Math.min(FARTHEST * this.first, this.distance * factor));
    this.eye = plus(target, this.forward, -this.distance);
  }

  // Rodrigues' formula on all three axes, made orthonormal again.
  rotate(axis, angle) {
    const c = Math.cos(angle), s = Math.sin(angle);
    const [x, y, z] = axis;
    const turned = ([a, b, e]) => {
      const along = (1 - c) * dot(axis, [a, b, e]);
      return [c * a + s * (y * e - z * b) + along * x, c * b + s * (z * a - x * e) + along * y, c * e + s * (x * b - y * a) + along * z];
    };
    this.forward = unit(turned(this.forward));
    const right = turned(this.right);
    this.right = unit(plus(right, this.forward, -dot(right, this.forward)));
    const [f, r] = [this.forward, this.right];
    this.down = [f[1] * r[2] - f[2] * r[1], f[2] * r[0] - f[0] * r[2], f[0] * r[1] - f[1] * r[0]];
  }

  // What drawing needs for a canvas: all that the lens sees is in it.
  view(width, height) {
    const { focal, centre, size } = this.lens;
    const scale = Math.min(width / size[0], height / size[1]);
    const turn = [...this.right, ...this.down, ...this.forward];
    return {
      turn,
      shift: [this.right, this.down, this.forward].map((axis) => -dot(axis, this.eye)),
      focal: focal.map((f) => f * scale),
      centre: [width / 2 + (centre[0] - size[0] / 2) * scale, height / 2 + (centre[1] - size[1] / 2) * scale],
    };
  }
}
