// Interactive 3D view of one clip's people, markings and cameras: drag to rotate, with playback.
"use strict";

function showScene(holder) {
  const scene = JSON.parse(holder.querySelector("script").textContent);
  const canvas = holder.querySelector("canvas");
  const pen = canvas.getContext("2d");
  const bar = holder.querySelector("input");
  const said = holder.querySelector("output");
  const button = (name) => holder.querySelector(`[data-do="${name}"]`);

  const numbers = (text, Kind) => {
    const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    return new Kind(bytes.buffer);
  };
  const joints = numbers(scene.joints, Int16Array);
  const broadcast = scene.broadcast ? numbers(scene.broadcast, Float32Array) : null;
  const { frames, persons, unit, bones, colors, ids } = scene;
  const MISSING = -32768;
  // Values of a broadcast camera per frame: rotation, translation, focal length, width, height.
  const CAMERA = 15;
  const stride = persons * 17 * 3;

  // Target point, rotation about the vertical, tilt above the ground, and distance.
  const home = { at: scene.middle, turn: -0.5, tilt: 0.42, far: scene.reach };
  let view = { ...home, at: [...home.at] };
  let through = false;
  let time = 0;
  let playing = false;
  let last = null;

  // World to canvas: a function of a point, giving place and scale [px/m], or null behind.
  function lens() {
    const { width, height } = canvas;
    if (through && broadcast) {
      const k = Math.min(frames - 1, Math.round(time)) * CAMERA;
      const focal = (broadcast[k + 12] * width) / broadcast[k + 13];
      if (!Number.isFinite(focal)) return () => null;
      return (x, y, z) => {
        const [right, down, depth] = [0, 1, 2].map((r) =>
          broadcast[k + 3 * r] * x + broadcast[k + 3 * r + 1] * y + broadcast[k + 3 * r + 2] * z +
          broadcast[k + 9 + r]);
        if (depth < 0.5) return null;
        return [width / 2 + (focal * right) / depth, height / 2 + (focal * down) / depth, focal / depth];
      };
    }
    const [s, c] = [Math.sin(view.turn), Math.cos(view.turn)];
    const [u, d] = [Math.sin(view.tilt), Math.cos(view.tilt)];
    const focal = 1.1 * Math.max(width, 1.4 * height);
    return (x, y, z) => {
      const [a, b, h] = [x - view.at[0], y - view.at[1], z - view.at[2]];
      const right = c * a + s * b;
      const ahead = -s * a + c * b;
      const depth = view.far + d * ahead - u * h;
      if (depth < 0.3) return null;
      const up = u * ahead + d * h;
      return [width / 2 + (focal * right) / depth, height / 2 - (focal * up) / depth, focal / depth];
    };
  }

  function stroke(project, points, closed = false) {
    pen.beginPath();
    let open = false;
    for (const [x, y, z] of points) {
      const seen = project(x, y, z);
      if (seen === null) open = false;
      else if (open) pen.lineTo(seen[0], seen[1]);
      else {
        pen.moveTo(seen[0], seen[1]);
        open = true;
      }
    }
    if (closed && open) pen.closePath();
    pen.stroke();
  }

  // A joint interpolated between two frames, for smooth playback of few frames.
  function joint(person, number) {
    const before = Math.floor(time);
    const share = time - before;
    const k = before * stride + (person * 17 + number) * 3;
    if (joints[k] === MISSING) return null;
    const next = k + stride;
    const there = share > 0 && before + 1 < frames && joints[next] !== MISSING;
    return [0, 1, 2].map((axis) => {
      const one = joints[k + axis];
      return unit * (there ? one + share * (joints[next + axis] - one) : one);
    });
  }

  function draw() {
    const ratio = window.devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth * ratio, canvas.clientHeight * ratio].map(Math.round);
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    const project = lens();
    pen.fillStyle = scene.markings.length ? "#3f6b45" : "#4a5560";
    pen.fillRect(0, 0, width, height);
    pen.lineCap = pen.lineJoin = "round";
    pen.lineWidth = 1.5 * ratio;
    pen.strokeStyle = "rgba(255, 255, 255, .85)";
    for (const line of scene.markings) stroke(project, line);
    pen.strokeStyle = "rgba(255, 255, 255, .16)";
    for (const line of scene.grid) stroke(project, line);
    drawCameras(project, ratio);
    drawPeople(project, ratio);
    bar.value = time;
    const frame = scene.first + Math.round(time) * scene.every;
    said.textContent = `frame ${frame}, ${((Math.round(time) * scene.every) / scene.fps).toFixed(2)} s`;
  }

  function drawCameras(project, ratio) {
    pen.font = `${11 * ratio}px system-ui, sans-serif`;
    pen.textAlign = "center";
    for (const { name, center } of scene.cameras) {
      const seen = project(...center);
      if (seen === null) continue;
      pen.fillStyle = "rgba(255, 255, 255, .8)";
      pen.beginPath();
      pen.arc(seen[0], seen[1], 3.5 * ratio, 0, 7);
      pen.fill();
      pen.fillText(name, seen[0], seen[1] - 7 * ratio);
    }
    if (!broadcast || through) return;
    const k = Math.min(frames - 1, Math.round(time)) * CAMERA;
    if (!Number.isFinite(broadcast[k])) return;
    const world = (point) =>
      [0, 1, 2].map((axis) => [0, 1, 2].reduce(
        (sum, r) => sum + broadcast[k + 3 * r + axis] * (point[r] - broadcast[k + 9 + r]), 0));
    const [focal, wide, high] = [broadcast[k + 12], broadcast[k + 13], broadcast[k + 14]];
    const center = world([0, 0, 0]);
    pen.strokeStyle = "rgba(255, 213, 74, .75)";
    // Intersections of the image corners with the ground.
    const corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([a, b]) => {
      const ahead = world([(a * wide) / 2 / focal, (b * high) / 2 / focal, 1]);
      const down = center[2] - ahead[2];
      const far = down > 0.01 ? Math.min(center[2] / down, 220) : 220;
      return center.map((value, axis) => value + far * (ahead[axis] - value));
    });
    stroke(project, corners, true);
    for (const corner of corners) stroke(project, [center, corner]);
  }

  function drawPeople(project, ratio) {
    const people = [];
    for (let person = 0; person < persons; person++) {
      const place = Array.from({ length: 17 }, (_, number) => joint(person, number));
      const hip = place[11] ?? place[5] ?? place.find((each) => each);
      const seen = hip && project(...hip);
      if (seen) people.push({ person, place, near: seen[2] });
    }
    pen.strokeStyle = "rgba(0, 0, 0, .28)";
    for (const { place, near } of people) {
      pen.lineWidth = Math.max(ratio, 0.09 * near);
      for (const [one, two] of bones) {
        if (place[one] && place[two]) {
          stroke(project, [place[one], place[two]].map(([x, y]) => [x, y, 0.01]));
        }
      }
    }
    people.sort((a, b) => a.near - b.near);
    for (const { person, place, near } of people) {
      pen.strokeStyle = pen.fillStyle = colors[person];
      pen.lineWidth = Math.max(1.6 * ratio, 0.085 * near);
      for (const [one, two] of bones) {
        if (place[one] && place[two]) stroke(project, [place[one], place[two]]);
      }
      const head = [0, 1, 2, 3, 4].map((number) => place[number]).filter((each) => each);
      if (!head.length) continue;
      const middle = [0, 1, 2].map((axis) => head.reduce((sum, each) => sum + each[axis], 0) / head.length);
      const seen = project(...middle);
      if (seen === null) continue;
      pen.beginPath();
      pen.arc(seen[0], seen[1], Math.max(2 * ratio, 0.115 * seen[2]), 0, 7);
      pen.fill();
      if (near > 9 * ratio) {
        pen.fillStyle = "#fff";
        pen.fillText(ids[person], seen[0], seen[1] - Math.max(6 * ratio, 0.22 * seen[2]));
      }
    }
  }

  function step(now) {
    if (!playing) return;
    if (last !== null) time += ((now - last) / 1000) * (scene.fps / scene.every);
    last = now;
    if (time > frames - 1) time = 0;
    draw();
    requestAnimationFrame(step);
  }

  function play(on) {
    playing = on && frames > 1;
    last = null;
    button("play").textContent = playing ? "Pause" : "Play";
    if (playing) requestAnimationFrame(step);
  }

  function look(change) {
    through = false;
    Object.assign(view, change);
    draw();
  }

  button("play").onclick = () => play(!playing);
  button("home").onclick = () => look({ ...home, at: [...home.at] });
  button("above").onclick = () => look({ ...home, at: [...home.at], turn: 0, tilt: 1.5 });
  button("side").onclick = () => look({ ...home, at: [...home.at], turn: 0, tilt: 0.06 });
  button("through").hidden = !broadcast;
  button("through").onclick = () => {
    through = true;
    draw();
  };
  bar.max = frames - 1;
  bar.oninput = () => {
    play(false);
    time = Number(bar.value);
    draw();
  };

  let held = null;
  canvas.onpointerdown = (event) => {
    held = [event.clientX, event.clientY];
    canvas.setPointerCapture(event.pointerId);
  };
  canvas.onpointerup = canvas.onpointercancel = () => (held = null);
  canvas.onpointermove = (event) => {
    if (held === null) return;
    const [dx, dy] = [event.clientX - held[0], event.clientY - held[1]];
    held = [event.clientX, event.clientY];
    if (event.shiftKey) {
      const scale = view.far / canvas.clientWidth;
      const [s, c] = [Math.sin(view.turn), Math.cos(view.turn)];
      const [right, ahead] = [-dx * scale, dy * scale];
      const at = [view.at[0] + c * right - s * ahead, view.at[1] + s * right + c * ahead, view.at[2]];
      look({ at });
    } else {
      const tilt = Math.min(1.57, Math.max(0.02, view.tilt + 0.006 * dy));
      look({ turn: view.turn - 0.006 * dx, tilt });
    }
  };
  const zoom = (factor) => look({ far: Math.min(400, Math.max(2, view.far * factor)) });
  canvas.addEventListener("wheel", (event) => {
    // Without a key the page scrolls: a report is read from top to bottom.
    if (!event.ctrlKey && !event.metaKey && document.activeElement !== canvas) return;
    event.preventDefault();
    zoom(Math.exp(0.0012 * event.deltaY));
  }, { passive: false });
  canvas.onkeydown = (event) => {
    const by = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (event.key === " ") play(!playing);
    else if (event.key === "+") zoom(0.85);
    else if (event.key === "-") zoom(1 / 0.85);
    else if (by) {
      play(false);
      time = Math.min(frames - 1, Math.max(0, Math.round(time) + by));
      draw();
    } else return;
    event.preventDefault();
  };

  new ResizeObserver(draw).observe(canvas);
  const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
  let begun = still;
  new IntersectionObserver(([seen]) => {
    if (!seen.isIntersecting) play(false);
    else if (!begun) {
      begun = true;
      play(true);
    }
  }, { threshold: 0.4 }).observe(canvas);
}

document.querySelectorAll(".scene").forEach(showScene);
