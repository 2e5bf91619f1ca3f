// Draws the .glb file of the chosen frame with three.js.
//
// A few surfaces are cached by path, and the next ones are prefetched. The camera keeps all surfaces shown so
// far in view until the user moves it; from then on it stays where the user put it.

import {
  Box3, Color, DirectionalLight, HemisphereLight, MeshStandardMaterial, PerspectiveCamera, Scene, Sphere, Vector3, WebGLRenderer,
} from './vendor/three.module.min.js';
import { GLTFLoader } from './vendor/GLTFLoader.js';
import { OrbitControls } from './vendor/OrbitControls.js';

const CACHED_MAX = 12;

export function makeScene(canvas) {
  const renderer = new WebGLRenderer({ canvas, antialias: true });
  const camera = new PerspectiveCamera(40, 1, 0.01, 1000);
  const controls = new OrbitControls(camera, canvas);
  const scene = new Scene();
  const sun = new DirectionalLight(0xffffff, 2.2);
  const material = new MeshStandardMaterial({ color: 0x4f9fdc, roughness: 0.35, metalness: 0 });
  const dark = matchMedia('(prefers-color-scheme: dark)');
  const cache = new Map(); // promises of surfaces, by path; the most recently used one is the last
  let current = null;
  let requested = null;
  let isMovedByUser = false;
  const seenBounds = new Box3();
  let isScheduled = false;
  // The light is behind the user's shoulder, so that every visible side is lit.
  sun.position.set(1, 2, 1.5);
  camera.add(sun, sun.target);
  sun.target.position.set(0, 0, -1);
  scene.add(new HemisphereLight(0xffffff, 0x556066, 1.6), camera);

  function paint() {
    if (isScheduled) return;
    isScheduled = true;
    requestAnimationFrame(() => {
      isScheduled = false;
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
    const response = await fetch(path);
    if (!response.ok) throw new Error(`the surface cannot be read (${response.status})`);
    const { scene: surface } = await new GLTFLoader().parseAsync(await response.arrayBuffer(), '');
    surface.traverse(part => {
      if (part.isMesh) part.material = material;
    });
    return surface;
  }

  function cached(path) {
    const surface = cache.get(path) ?? load(path);
    cache.delete(path);
    cache.set(path, surface);
    // A failed request is removed, so that the next request for this path tries again.
    surface.catch(() => cache.delete(path));
    for (const [other, old] of cache) {
      if (cache.size <= CACHED_MAX) break;
      if (other === requested) continue;
      cache.delete(other);
      old.then(dispose, () => {});
    }
    return surface;
  }

  function dispose(surface) {
    if (surface === current) return;
    surface.traverse(part => part.geometry?.dispose());
  }

  /** Moves the camera back until this surface and all earlier ones are in view. */
  function fitCamera(surface) {
    const box = new Box3().setFromObject(surface);
    if (isMovedByUser || box.isEmpty() || seenBounds.containsBox(box)) return;
    seenBounds.union(box);
    const sphere = seenBounds.getBoundingSphere(new Sphere());
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
    requested = path;
    const surface = await cached(path);
    next.forEach(cached);
    if (requested !== path) return;
    if (current) scene.remove(current);
    current = surface;
    scene.add(surface);
    fitCamera(surface);
    paint();
  }

  /** Shows nothing. */
  function clear() {
    requested = null;
    if (current) scene.remove(current);
    current = null;
    paint();
  }

  controls.addEventListener('start', () => { isMovedByUser = true; });
  controls.addEventListener('change', paint);
  dark.addEventListener('change', paint);
  new ResizeObserver(paint).observe(canvas);
  paint();
  return { show, clear };
}
