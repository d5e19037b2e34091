"""The style sheet of a report, light and dark."""

STYLE = """
:root{--ink:#1c2128;--soft:#57606a;--back:#fff;--card:#f6f8fa;--line:#d8dee4;--real:#c8374a;--imagined:#2f6aa8;
--link:#0b62c4;--warn:#9a6700;--warnback:#fff8e1;
--c0:#2f6aa8;--c1:#d9730d;--c2:#2e8b57;--c3:#c8374a;--c4:#7d5bc4;--c5:#8a6d3b;--c6:#c2568f;--c7:#4d7f86}
@media(prefers-color-scheme:dark){:root{--ink:#e6edf3;--soft:#9da7b1;--back:#0f1318;--card:#181e25;--line:#303943;
--real:#ff7b88;--imagined:#6cb0f5;--link:#79b8ff;--warn:#e3b341;--warnback:#2b2411;
--c0:#6cb0f5;--c1:#f0a35e;--c2:#63c98f;--c3:#ff7b88;--c4:#b59cf2;--c5:#d2b077;--c6:#f093c4;--c7:#7fc1ca}}
*{box-sizing:border-box}
html{scroll-behavior:smooth;scroll-padding-top:1rem}
body{margin:0;color:var(--ink);background:var(--back);font:15px/1.5 system-ui,"Segoe UI","DejaVu Sans",sans-serif}
#content{display:grid;grid-template-columns:12rem minmax(0,64rem);gap:2rem;max-width:82rem;margin:auto;padding:1.5rem}
nav{position:sticky;top:1.5rem;align-self:start;font-size:14px;color:var(--soft);max-height:95vh;overflow:auto}
nav ol{list-style:none;margin:.4rem 0;padding:0;border-left:2px solid var(--line)}
nav a{display:block;padding:.15rem .8rem;color:inherit;text-decoration:none}
nav a:hover,a:hover{color:var(--link);text-decoration:underline}
a{color:var(--link)}
h1{font-size:1.7rem;line-height:1.2;margin:0 0 .3rem}
h2{font-size:1.2rem;margin:2.4rem 0 .7rem;padding-bottom:.25rem;border-bottom:1px solid var(--line)}
h3{font-size:1rem;margin:1.2rem 0 .3rem}
p{max-width:48rem;margin:.5rem 0}
.soft,figcaption{color:var(--soft)}
code,pre{font:13px/1.45 ui-monospace,"DejaVu Sans Mono",monospace;background:var(--card);border-radius:4px}
code{padding:.1em .3em;overflow-wrap:anywhere}
pre{padding:.7rem .9rem;overflow:auto}
.cards{display:grid;grid-template-columns:repeat(auto-fit,minmax(11rem,1fr));gap:.7rem;margin:1rem 0}
.cards>div{background:var(--card);border:1px solid var(--line);border-radius:8px;padding:.6rem .9rem}
dt{color:var(--soft);font-size:13px}
dd{margin:0;font-size:1.15rem;font-weight:600}
dd small{font-weight:400;font-size:13px;color:var(--soft);display:block}
.scroll{overflow-x:auto}
table{border-collapse:collapse;font-size:14px;font-variant-numeric:tabular-nums;margin:.6rem 0}
th,td{padding:.3rem .5rem;border-bottom:1px solid var(--line);text-align:right;vertical-align:top}
td{white-space:nowrap}
th{color:var(--soft);font-weight:600;vertical-align:bottom}
th:first-child,td:first-child,.words th,.words td{text-align:left}
.words td{min-width:9rem;overflow-wrap:anywhere;white-space:normal}
figure{margin:1rem 0;background:var(--card);border:1px solid var(--line);border-radius:8px;padding:.7rem .8rem}
figcaption{font-size:13px;margin-bottom:.3rem}
figcaption b{color:var(--ink);font-size:14px}
.grid-of{display:grid;grid-template-columns:repeat(auto-fill,minmax(17.5rem,1fr));gap:.8rem}
.grid-of figure{margin:0}
.wide{max-width:56rem}
svg{width:100%;height:auto;display:block;overflow:visible}
svg text{font-size:12px;fill:var(--soft)}
svg text.name{fill:var(--ink)}
.legend{display:flex;flex-wrap:wrap;gap:.2rem 1.1rem;font-size:13px;color:var(--soft);margin-top:.3rem}
.legend span{display:inline-flex;align-items:center;gap:.4rem}
svg.key{width:22px;height:16px;flex:none}
svg.key.inline{display:inline-block;vertical-align:middle}
svg.spark{width:110px;height:26px}
svg line,svg polyline{fill:none;stroke:currentColor;stroke-width:2;stroke-linejoin:round}
svg .grid{stroke:var(--line);stroke-width:1}
svg line.level{stroke:var(--soft);stroke-width:1.2;stroke-dasharray:2 4}
svg .thin{stroke-width:1;opacity:.45}
svg .faint{stroke-width:.6;opacity:.28}
svg .dashed{stroke-dasharray:7 4}
svg .dotted{stroke-dasharray:2 3}
svg .band{stroke:none;opacity:.17}
svg .band.deep{opacity:.3}
svg circle{stroke:none}
.real{stroke:var(--real)}circle.real,.band.real{fill:var(--real)}
.imagined{stroke:var(--imagined)}circle.imagined,.band.imagined{fill:var(--imagined)}
.c0{stroke:var(--c0)}circle.c0,.band.c0{fill:var(--c0)}.c1{stroke:var(--c1)}circle.c1,.band.c1{fill:var(--c1)}
.c2{stroke:var(--c2)}circle.c2,.band.c2{fill:var(--c2)}.c3{stroke:var(--c3)}circle.c3,.band.c3{fill:var(--c3)}
.c4{stroke:var(--c4)}circle.c4,.band.c4{fill:var(--c4)}.c5{stroke:var(--c5)}circle.c5,.band.c5{fill:var(--c5)}
.c6{stroke:var(--c6)}circle.c6,.band.c6{fill:var(--c6)}.c7{stroke:var(--c7)}circle.c7,.band.c7{fill:var(--c7)}
details{border:1px solid var(--line);border-radius:8px;margin:.6rem 0;padding:.2rem .9rem}
details[open]{padding-bottom:.8rem}
summary{cursor:pointer;padding:.35rem 0;font-weight:600}
summary .soft{font-weight:400}
.finding{border-left:4px solid var(--line);background:var(--card);border-radius:0 8px 8px 0;padding:.5rem 1rem;
margin:.6rem 0;max-width:52rem}
.finding.warning{border-color:var(--warn);background:var(--warnback)}
.finding p{margin:.2rem 0}
video{max-width:100%;width:40rem;border-radius:8px;border:1px solid var(--line)}
.file{display:inline-block;margin:.2rem .8rem .2rem 0}
#live{position:fixed;right:1rem;bottom:1rem;background:var(--card);border:1px solid var(--line);border-radius:8px;
padding:.35rem .8rem;font-size:13px;color:var(--soft)}
@media(max-width:60rem){#content{grid-template-columns:minmax(0,1fr);gap:1rem}nav{position:static}}
@media print{nav,#live{display:none}#content{display:block}figure{break-inside:avoid}}
"""
