// Draws the .glb file of the chosen frame with three.js.
//
// A few surfaces are cached by path, and the next ones are prefetched. The camera keeps all surfaces shown so
// far in view until the user moves it; from then on it stays where the user put it.

import {
  Box3, Color, DirectionalLight, HemisphereLight, MeshStandardMaterial, PerspectiveCamera, Scene, Sphere, Vector3, WebGLRenderer,
} from './vendor/three.module.min.js';
import { GLTFLoader } from './vendor/GLTFLoader.js';
import { OrbitControls } from './vendor/OrbitControls.js';

const KEPT = 12;

export function makeScene(canvas) {
  const renderer = new WebGLRenderer({ canvas, antialias: true });
  const camera = new PerspectiveCamera(40, 1, 0.01, 1000);
  const controls = new OrbitControls(camera, canvas);
  const scene = new Scene();
  const sun = new DirectionalLight(0xffffff, 2.2);
  const material = new MeshStandardMaterial({ color: 0x4f9fdc, roughness: 0.35, metalness: 0 });
  const dark = matchMedia('(prefers-color-scheme: dark)');
  const kept = new Map(); // promises of surfaces, by address; the one that was used last is the last
  let current = null;
  let wanted = null;
  let isHeld = false;
  const seen = new Box3();
  let isAsked = false;
  // The light is behind the user's shoulder, so that every visible side is lit.
  sun.position.set(1, 2, 1.5);
  camera.add(sun, sun.target);
  sun.target.position.set(0, 0, -1);
  scene.add(new HemisphereLight(0xffffff, 0x556066, 1.6), camera);

  function paint() {
    if (isAsked) return;
    isAsked = true;
    requestAnimationFrame(() => {
      isAsked = false;
      const [width, height] = [canvas.clientWidth, canvas.clientHeight];
      if (!width || !height) return;
      renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
      renderer.setSize(width, height, false);
      camera.aspect = width / height;
      camera.updateProjectionMatrix();
      scene.background = new Color(dark.matches ? 0x1a2127 : 0xffffff);
      renderer.render(scene, camera);
    });
  }

  async function load(path) {
    const answer = await fetch(path);
    if (!answer.ok) throw new Error(`the surface cannot be read (${answer.status})`);
    const { scene: surface } = await new GLTFLoader().parseAsync(await answer.arrayBuffer(), '');
    surface.traverse(part => {
      if (part.isMesh) part.material = material;
    });
    return surface;
  }

  function take(path) {
    const surface = kept.get(path) ?? load(path);
    kept.delete(path);
    kept.set(path, surface);
    // A failed request is removed, so that the next request for this path tries again.
    surface.catch(() => kept.delete(path));
    for (const [other, old] of kept) {
      if (kept.size <= KEPT) break;
      if (other === wanted) continue;
      kept.delete(other);
      old.then(free, () => {});
    }
    return surface;
  }

  function free(surface) {
    if (surface === current) return;
    surface.traverse(part => part.geometry?.dispose());
  }

  /** Moves the camera back until this surface and all earlier ones are in view. */
  function place(surface) {
    const box = new Box3().setFromObject(surface);
    if (isHeld || box.isEmpty() || seen.containsBox(box)) return;
    seen.union(box);
    const sphere = seen.getBoundingSphere(new Sphere());
    // The narrower side determines the distance: on a phone held upright, that is the width.
    const half = Math.atan(Math.tan(camera.fov * Math.PI / 360) * Math.min(1, canvas.clientWidth / Math.max(1, canvas.clientHeight)));
    const distance = Math.max(sphere.radius, 1e-6) / Math.sin(half) * 0.9;
    camera.near = distance / 1000;
    camera.far = distance * 20;
    camera.position.copy(sphere.center).addScaledVector(new Vector3(0.6, 0.45, 1).normalize(), distance);
    controls.target.copy(sphere.center);
    controls.update();
  }

  /** Shows the surface at `path`, and prefetches those at `next`. */
  async function show(path, next) {
    wanted = path;
    const surface = await take(path);
    next.forEach(take);
    if (wanted !== path) return;
    if (current) scene.remove(current);
    current = surface;
    scene.add(surface);
    place(surface);
    paint();
  }

  /** Shows nothing. */
  function clear() {
    wanted = null;
    if (current) scene.remove(current);
    current = null;
    paint();
  }

  controls.addEventListener('start', () => { isHeld = true; });
  controls.addEventListener('change', paint);
  dark.addEventListener('change', paint);
  new ResizeObserver(paint).observe(canvas);
  paint();
  return { show, clear };
}
