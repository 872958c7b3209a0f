// Bundles the page into dist/, which is committed: `sat3d` embeds it, and a build of `sat3d` needs no Node.
import { build } from 'esbuild';
import { copyFile, mkdir } from 'node:fs/promises';

await mkdir('dist', { recursive: true });
await build({
	entryPoints: ['src/viewer.js'],
	outfile: 'dist/viewer.js',
	bundle: true,
	minify: true,
	format: 'esm',
	target: 'es2022',
	charset: 'utf8',
	// The notices are in NOTICE, which is served beside the bundle.
	legalComments: 'none',
	banner: { js: '/* sat3d view. Contains three.js, 3d-tiles-renderer and meshoptimizer: see licences.txt. */' },
	logLevel: 'warning',
});
for (const name of ['index.html', 'viewer.css']) await copyFile(`src/${name}`, `dist/${name}`);
