// Renders a .glb from the front with three.js in headless Chromium: node show_in_three.mjs MODEL.glb OUT.png [unlit|LIGHT.exr]
// The picture is 2048 x 2048, to be averaged over 4 x 4 pixels in linear light: browsers average what is encoded.
// Needs npm packages three and playwright-core (npm install in this folder, or NODE_PATH) and a Chromium: CHROMIUM, else
// /usr/bin/chromium. Orthographic, half-width 0.72 of the longest side, sun from the upper left, like show_in_blender.py.
import { createServer } from 'node:http';
import { readFileSync } from 'node:fs';
import { createRequire } from 'node:module';
import { dirname, extname, join, normalize } from 'node:path';

const [model, out, mode] = process.argv.slice(2);
const require = createRequire(import.meta.url);
const paths = [process.cwd(), import.meta.dirname, ...(process.env.NODE_PATH ?? '').split(':').filter(Boolean)];
const three = dirname(dirname(require.resolve('three', { paths })));
const { chromium } = require(require.resolve('playwright-core', { paths }));

const types = { '.html': 'text/html', '.js': 'text/javascript', '.glb': 'model/gltf-binary' };
const server = createServer((request, response) => {
  const path = normalize(new URL(request.url, 'http://localhost').pathname);
  const file = path === '/' ? join(import.meta.dirname, 'show_in_three.html') : path === '/model.glb' ? model : path === '/light.exr' ? mode
    : path.startsWith('/three/') ? join(three, path.slice(7)) : null;
  try {
    const body = readFileSync(file);
    response.writeHead(200, { 'Content-Type': types[extname(file)] ?? 'application/octet-stream' }).end(body);
  } catch {
    response.writeHead(404).end();
  }
});
await new Promise((ready) => server.listen(0, '127.0.0.1', ready));

const browser = await chromium.launch({
  executablePath: process.env.CHROMIUM ?? '/usr/bin/chromium',
  args: ['--no-sandbox', '--use-gl=angle', '--use-angle=swiftshader', '--enable-unsafe-swiftshader'],
});
try {
  const page = await browser.newPage({ viewport: { width: 512, height: 512 }, deviceScaleFactor: 4 });
  page.on('console', (message) => console.error(message.text()));
  await page.goto(`http://127.0.0.1:${server.address().port}/${!mode ? '' : mode === 'unlit' ? '?unlit' : '?light'}`);
  await page.waitForFunction(() => window.done, null, { timeout: 60_000 });
  const done = await page.evaluate(() => window.done);
  console.log(JSON.stringify(done));
  if (done.error) process.exitCode = 1;
  else await page.screenshot({ path: out, omitBackground: true });
} finally {
  await browser.close();
  server.close();
}
