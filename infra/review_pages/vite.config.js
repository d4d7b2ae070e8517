import { svelte } from "@sveltejs/vite-plugin-svelte";
import { defineConfig } from "vite";

// The built files are committed: plain names, so that a change is a change and not a new file.
export default defineConfig({
  plugins: [svelte()],
  build: {
    outDir: "../../flows/pages/static",
    emptyOutDir: true,
    modulePreload: { polyfill: false },
    rollupOptions: {
      output: {
        entryFileNames: "assets/pages.js",
        chunkFileNames: "assets/[name].js",
        assetFileNames: "assets/pages[extname]",
      },
    },
  },
});
