import { createHash } from "node:crypto";
import { readdirSync, readFileSync, writeFileSync } from "node:fs";
import { join } from "node:path";
import { svelte } from "@sveltejs/vite-plugin-svelte";
import { defineConfig } from "vite";

// What the built files are made from; a test compares its digest with the one that is written beside them.
function sourceDigest() {
  const top = ["index.html", "package-lock.json", "viewer.config.js", "viewer.html", "vite.config.js"];
  const inside = readdirSync("src", { recursive: true, withFileTypes: true })
    .filter((each) => each.isFile())
    .map((each) => join(each.parentPath, each.name).replaceAll("\\", "/"));
  const hash = createHash("sha256");
  for (const path of [...top, ...inside].sort()) hash.update(`${path}\0`).update(readFileSync(path)).update("\0");
  return hash.digest("hex");
}

const builtFrom = {
  name: "built-from",
  writeBundle: (options) => writeFileSync(join(options.dir, "built_from.sha256"), `${sourceDigest()}\n`),
};

// The built files are committed: plain names, so that a change is a change and not a new file.
export default defineConfig({
  plugins: [svelte(), builtFrom],
  build: {
    outDir: "../../flows/web/static",
    emptyOutDir: true,
    modulePreload: { polyfill: false },
    rollupOptions: {
      output: {
        entryFileNames: "assets/pages.js",
        chunkFileNames: "assets/[name].js",
        assetFileNames: "assets/[name][extname]",
      },
    },
  },
});
