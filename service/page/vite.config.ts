import { defineConfig } from "vite";

export default defineConfig({
  base: "./", // the service may live under a path of a proxy
  build: {
    target: "es2022",
    assetsInlineLimit: 0, // the page's Content-Security-Policy has no data: addresses
    modulePreload: { polyfill: false },
    chunkSizeWarningLimit: 800,
    rolldownOptions: {
      output: {
        // three.js changes more seldom than the page, and only the viewer loads it.
        codeSplitting: {
          groups: [{ name: "three", test: /node_modules[\\/]three[\\/]/ }],
        },
      },
    },
  },
  server: {
    proxy: Object.fromEntries(
      ["/v1", "/problems", "/docs", "/openapi.json", "/readyz"].map((path) => [
        path,
        process.env.SMSR_SERVER ?? "http://127.0.0.1:8000",
      ]),
    ),
  },
});
