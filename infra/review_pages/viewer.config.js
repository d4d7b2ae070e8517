import { svelte } from "@sveltejs/vite-plugin-svelte";
import { defineConfig } from "vite";

// The viewer as one page: scripts and style stand inside, after the place of the data.
const inline = {
  name: "inline",
  enforce: "post",
  generateBundle: {
    order: "post",
    handler(_, bundle) {
      const all = Object.values(bundle);
      const page = all.find((each) => each.fileName === "viewer.html");
      const script = all.filter((each) => each.type === "chunk").map((each) => each.code).join("\n").replaceAll("</script", "<\\/script");
      const style = all.filter((each) => each.fileName.endsWith(".css")).map((each) => each.source).join("\n");
      page.source = page.source
        .replace(/\s*<script[^>]*src=[^>]*><\/script>/g, "")
        .replace(/\s*<link[^>]*stylesheet[^>]*>/g, "")
        .replace("</head>", () => `  <style>${style.trim()}</style>\n  </head>`)
        .replace("</body>", () => `  <script type="module">${script.trim()}</script>\n  </body>`);
      for (const each of all) if (each !== page) delete bundle[each.fileName];
    },
  },
};

export default defineConfig({
  plugins: [svelte(), inline],
  build: {
    outDir: "../../flows/reports",
    emptyOutDir: false,
    modulePreload: false,
    rollupOptions: { input: "viewer.html" },
  },
});
