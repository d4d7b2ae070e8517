// A viewer file: clips are in its scripts of data, as worldpose/formats/viewer_file.py writes them.

import { mount } from "svelte";
import ViewerFile from "./ViewerFile.svelte";
import { unpack } from "./payload.js";
import "../style.css";

function bytesOf(text) {
  if (Uint8Array.fromBase64) return Uint8Array.fromBase64(text);
  const plain = atob(text);
  const bytes = new Uint8Array(plain.length);
  for (let k = 0; k < plain.length; k++) bytes[k] = plain.charCodeAt(k);
  return bytes;
}

function clipOf(number) {
  const part = (name) => document.querySelector(`script[data-clip="${number}"][data-part="${name}"]`);
  const read = (name) => bytesOf(part(name).textContent).buffer;
  const opened = read("scene");
  const scene = unpack(opened);
  const video = part("video") && URL.createObjectURL(new Blob([read("video")], { type: "video/mp4" }));
  const source = { scene: async () => opened, frames: async (first) => read(String(Math.floor(first / scene.range_frames))) };
  return { scene, source, video };
}

const count = document.querySelectorAll('script[data-part="scene"]').length;
const target = document.getElementById("app");
if (count) {
  const clips = Array.from({ length: count }, (_, number) => clipOf(number));
  target.replaceChildren();
  mount(ViewerFile, { target, props: { clips } });
} else {
  target.textContent = "This file holds no clip: write it again with worldpose export --format viewer.";
}
