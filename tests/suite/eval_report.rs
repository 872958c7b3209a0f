//! What an evaluation looks like from outside: JSON against its schema, CSV and Parquet in pandas,
//! pyarrow and geopandas, the report in a real browser without a window.
//!
//! `SAT3D_TEST_PYTHON` names an interpreter and `SAT3D_TEST_BROWSER` a Chromium; without them
//! `python3` and the usual names are tried, and tests that need what is not there say that they
//! were skipped.

use crate::eval_support::sample;
use crate::eval_support::schema;

use sat3d::eval::report::{html, json, per_image_table, terminal};
use sat3d::eval::summary::EvaluationSet;
use sat3d::eval::{Protocol, published};
use serde_json::Value;
use std::ffi::OsString;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

/// Says that a test was skipped, past the harness, which hides what `eprintln!` says.
fn skipped(test: &str, why: &str) {
    let _ = writeln!(std::io::stderr(), "SKIPPED {test}: {why}");
}

/// Everything that looks different: one evaluation, one with published rows, models, protocols,
/// and nothing that could be scored.
fn sets() -> Vec<(&'static str, EvaluationSet)> {
    let one = || sample::set(&["out"], &[Protocol::Paper], 60);
    let mut against = one();
    against.published = published::paper_rows();
    let mut several = sample::set(&["out", "<i>base</i>"], &Protocol::ALL, 30);
    several.published = published::paper_rows();
    vec![
        ("one", one()),
        ("against", against),
        ("several", several),
        ("nothing", sample::nothing()),
        ("empty", EvaluationSet { evaluations: vec![], differences: vec![], published: vec![] }),
    ]
}

/// A file of `docs/`.
fn docs(name: &str) -> PathBuf {
    // Two folders, because this file may be built by a crate beside this one.
    let from_source = Path::new(file!()).parent().and_then(Path::parent);
    let roots = [Some(Path::new(env!("CARGO_MANIFEST_DIR"))), from_source];
    let mut found = roots.into_iter().flatten().map(|root| root.join("docs").join(name));
    found.find(|path| path.exists()).unwrap_or_else(|| panic!("docs/{name} is there"))
}

fn schema_path() -> PathBuf {
    docs("schemas/eval.schema.json")
}

#[test]
fn every_column_is_documented() {
    let text = std::fs::read_to_string(docs("eval-output.md")).expect("readable");
    let table = per_image_table(&sets()[0].1).expect("a table");
    for column in table.columns() {
        assert!(text.contains(&format!("`{}`", column.name)), "{}", column.name);
    }
}

#[test]
fn json_has_what_its_schema_says_and_nothing_else() {
    let text = std::fs::read_to_string(schema_path()).expect("readable");
    let schema: Value = serde_json::from_str(&text).expect("JSON");
    for (name, set) in sets() {
        let document = json(&set);
        let faults = schema::faults(&schema, &document);
        assert!(faults.is_empty(), "{name}: {faults:#?}");
    }
    // The check can fail: a field too many, one too few, a number that is text.
    for (change, fault) in [("extra", "no such field"), ("gone", "is missing"), ("text", "type")] {
        let mut document = json(&sets()[0].1);
        match change {
            "extra" => document["pooled"]["mae"] = 1.into(),
            "gone" => {
                document["images"].as_object_mut().expect("an object").remove("evaluated");
            }
            _ => document["per_image"][0]["mae_m"] = "3.2".into(),
        }
        let faults = schema::faults(&schema, &document);
        assert!(faults.iter().any(|f| f.contains(fault)), "{change}: {faults:?}");
    }
}

#[test]
fn json_holds_what_was_asked_for() {
    let document = json(&sets()[0].1);
    for path in [
        "/protocol",
        "/images/evaluated",
        "/images/skipped",
        "/images/failed",
        "/per_image_mean/mae_m",
        "/per_image_mean/rmse_m",
        "/pooled/mae_m",
        "/pooled/rmse_m",
        "/pooled/bias_m",
        "/pooled/median_m",
        "/pooled/nmad_m",
        "/pooled/le90_m",
        "/pooled/lt_2_5_m_pct",
        "/pooled/lt_7_5_m_pct",
        "/pooled/pixels",
        "/per_image/0/name",
        "/per_image/0/mae_m",
        "/per_image/0/rmse_m",
        "/per_image/0/lt_2_5_m_pct",
        "/per_image/0/lt_7_5_m_pct",
        "/per_image/0/shift_px/x",
        "/per_image/0/shift_px/y",
        "/per_image/0/rotation_deg",
        "/per_image/0/vertical_offset_m",
        "/per_image/0/pixels",
    ] {
        assert!(document.pointer(path).is_some_and(|v| !v.is_null()), "{path}");
    }
}

/// The interpreter, if it can import `modules`.
fn python(test: &str, modules: &str) -> Option<Command> {
    let interpreter = std::env::var_os("SAT3D_TEST_PYTHON").unwrap_or_else(|| "python3".into());
    let has = Command::new(&interpreter).args(["-c", &format!("import {modules}")]).output();
    if has.is_ok_and(|output| output.status.success()) {
        return Some(Command::new(interpreter));
    }
    skipped(test, &format!("no python with {modules} (set SAT3D_TEST_PYTHON)"));
    None
}

fn run(mut python: Command, script: &str, arguments: &[&Path]) -> String {
    let output = python.args(["-c", script]).args(arguments).output().expect("python runs");
    let error = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{error}");
    String::from_utf8(output.stdout).expect("text").trim().to_owned()
}

#[test]
fn json_validates_by_the_jsonschema_library() {
    let Some(mut python) = python("json_validates_by_the_jsonschema_library", "jsonschema") else {
        return;
    };
    let folder = tempfile::tempdir().expect("a folder");
    for (name, set) in sets() {
        std::fs::write(folder.path().join(name), json(&set).to_string()).expect("writes");
    }
    python.env("PYTHONWARNINGS", "error");
    let script = "import sys, json, os, jsonschema\n\
        schema = json.load(open(sys.argv[1]))\n\
        jsonschema.Draft202012Validator.check_schema(schema)\n\
        validator = jsonschema.Draft202012Validator(schema)\n\
        for name in sorted(os.listdir(sys.argv[2])):\n\
        \x20   document = json.load(open(os.path.join(sys.argv[2], name)))\n\
        \x20   validator.validate(document)\n\
        \x20   document['surprise'] = 1\n\
        \x20   assert not validator.is_valid(document)\n\
        print('valid')";
    assert_eq!(run(python, script, &[&schema_path(), folder.path()]), "valid");
}

#[test]
fn csv_and_parquet_say_the_same_in_pandas_and_geopandas() {
    let test = "csv_and_parquet_say_the_same_in_pandas_and_geopandas";
    let Some(python) = python(test, "pandas, pyarrow.parquet, geopandas") else { return };
    let folder = tempfile::tempdir().expect("a folder");
    let set = sample::set(&["out", "base, \"line\""], &[Protocol::Paper, Protocol::Coregister], 60);
    let table = per_image_table(&set).expect("a table");
    let [csv, parquet, document] =
        ["a.csv", "a.parquet", "a.json"].map(|name| folder.path().join(name));
    table.write_csv(&csv).expect("writes");
    table.write_parquet(&parquet).expect("writes");
    std::fs::write(&document, json(&set).to_string()).expect("writes");
    let script = "import sys, json\n\
        import pandas, geopandas, pyarrow.parquet\n\
        csv = pandas.read_csv(sys.argv[1], float_precision='round_trip')\n\
        geo = geopandas.read_parquet(sys.argv[2])\n\
        images = [(e, i) for e in json.load(open(sys.argv[3]))['evaluations'] for i in e['per_image']]\n\
        assert len(csv) == len(geo) == len(images) == 240\n\
        assert [c for c in geo.columns if c != 'geometry'] == list(csv.columns)\n\
        for name in csv.columns:\n\
        \x20   a, b = csv[name], geo[name]\n\
        \x20   if a.dtype.kind == 'f':\n\
        \x20       assert ((a == b) | (a.isna() & b.isna())).all(), name\n\
        \x20   else:\n\
        \x20       assert (a.fillna('') == b.fillna('')).all(), name\n\
        for (e, i), (_, row) in zip(images, geo.iterrows()):\n\
        \x20   assert (row['model'], row['protocol'], row['name'], row['status']) == (e['model'], e['protocol'], i['name'], i['status'])\n\
        \x20   assert (row.geometry.x, row.geometry.y) == (i['lon_deg'], i['lat_deg'])\n\
        \x20   if i['status'] == 'done':\n\
        \x20       for key in ['mae_m', 'rmse_m', 'pixels', 'vertical_offset_m', 'le90_m']:\n\
        \x20           assert row[key] == i[key], key\n\
        \x20       assert (row['shift_x_px'], row['shift_y_m']) == (i['shift_px']['x'], i['shift_m']['y'])\n\
        \x20   else:\n\
        \x20       assert pandas.isna(row['mae_m']) and row['reason']\n\
        assert geo.crs.to_string() in ('OGC:CRS84', 'EPSG:4326'), geo.crs\n\
        told = json.loads(pyarrow.parquet.read_metadata(sys.argv[2]).metadata[b'sat3d:columns'])\n\
        assert set(told) == set(geo.columns) and all(told.values())\n\
        print('same')";
    assert_eq!(run(python, script, &[&csv, &parquet, &document]), "same");
}

#[test]
fn the_terminal_fits_and_the_first_line_counts() {
    for (name, set) in sets() {
        let text = terminal(&set, 80);
        assert!(text.lines().all(|line| line.chars().count() <= 80), "{name}\n{text}");
        assert!(set.evaluations.is_empty() || text.starts_with("evaluated "), "{name}\n{text}");
        assert!(!text.contains("NaN"), "{name}\n{text}");
    }
}

/// A Chromium, by `SAT3D_TEST_BROWSER` or by its usual names.
fn browser(test: &str) -> Option<OsString> {
    let named = std::env::var_os("SAT3D_TEST_BROWSER");
    let usual = ["chromium", "chromium-browser", "google-chrome", "chrome"].map(OsString::from);
    let works = |name: &OsString| {
        let asked = Command::new(name).arg("--version").stderr(Stdio::null()).output();
        asked.is_ok_and(|output| output.status.success())
    };
    let found = named.into_iter().chain(usual).find(works);
    if found.is_none() {
        skipped(test, "no Chromium (set SAT3D_TEST_BROWSER)");
    }
    found
}

/// Opens a page without a window and gives its document after scripts have run.
fn open(browser: &OsString, page: &Path, dark: bool, picture: Option<&Path>) -> String {
    let profile = tempfile::tempdir().expect("a folder");
    let output = tempfile::NamedTempFile::new().expect("a file");
    let mut command = Command::new(browser);
    command
        .args(["--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"])
        .args(["--disable-background-networking", "--disable-component-update", "--disable-sync"])
        .args(["--disable-dev-shm-usage", "--hide-scrollbars", "--window-size=1200,1600"])
        .arg("--virtual-time-budget=3000")
        .arg(format!("--blink-settings=preferredColorScheme={}", if dark { 0 } else { 1 }))
        .arg(format!("--user-data-dir={}", profile.path().display()));
    match picture {
        Some(picture) => command.arg(format!("--screenshot={}", picture.display())),
        None => command.arg("--dump-dom"),
    };
    let mut child = command
        .arg(format!("file://{}", page.display()))
        .stdout(output.reopen().expect("opens"))
        .stderr(Stdio::null())
        .spawn()
        .expect("the browser starts");
    let start = Instant::now();
    while child.try_wait().expect("a child").is_none() {
        if start.elapsed() > Duration::from_secs(120) {
            let _ = child.kill();
            let _ = child.wait();
            panic!("the browser did not finish with {}", page.display());
        }
        std::thread::sleep(Duration::from_millis(20));
    }
    std::fs::read_to_string(output.path()).expect("text")
}

/// Notes what goes wrong before the page's own script runs.
const BEFORE: &str = "<script>window.faults=[];\
    addEventListener('error',e=>faults.push('error '+(e.message||e.target.tagName)),true);\
    addEventListener('securitypolicyviolation',e=>faults.push('blocked '+e.blockedURI));</script>";
/// Uses the page and notes what it finds as attributes of the root.
const AFTER: &str = "<script>addEventListener('load',()=>{\
    const d=document.documentElement.dataset,all=q=>[...document.querySelectorAll(q)];\
    const background=()=>getComputedStyle(document.body).backgroundColor;\
    d.pictures=all('img').filter(i=>i.complete&&i.naturalWidth>0).length+' of '+all('img').length;\
    d.tables=all('table').length;d.captions=all('table caption').length;\
    d.drawn=all('figure > svg').every(s=>s.getBoundingClientRect().height>50&&s.querySelector('title')&&s.querySelector('desc'));\
    d.wide=document.documentElement.scrollWidth<=innerWidth;\
    d.first=background();document.getElementById('theme').click();d.second=background();\
    document.getElementById('theme').click();d.third=background();\
    const t=document.querySelector('table.images');\
    if(t){const column=()=>[...t.tBodies[0].rows].map(r=>parseFloat(r.cells[1].textContent));\
    const sorted=f=>column().every((v,i,a)=>!i||f(a[i-1],v));\
    const head=t.tHead.rows[0].cells[1];head.click();const down=sorted((a,b)=>a>=b);\
    head.click();const up=sorted((a,b)=>a<=b);d.sorted=down+' '+up+' '+column().length;}\
    d.requests=performance.getEntriesByType('resource').filter(e=>!e.name.startsWith('data:')).length;\
    d.faults=faults.join('|')||'none';});</script>";

/// The page with the test's own scripts around it.
fn instrumented(page: &str) -> String {
    let page = page.replacen("<title>", &format!("{BEFORE}<title>"), 1);
    page.replacen("</body>", &format!("{AFTER}</body>"), 1)
}

/// The value of a `data-` attribute of the root.
fn noted<'a>(document: &'a str, name: &str) -> &'a str {
    let root = document.split_once("<html").expect("a root").1;
    let root = root.split_once("<head").expect("a head").0;
    let start = format!("data-{name}=\"");
    let value = root.split_once(start.as_str());
    value.and_then(|(_, rest)| rest.split_once('"')).map_or("", |(value, _)| value)
}

#[test]
fn the_report_opens_in_a_browser() {
    let Some(browser) = browser("the_report_opens_in_a_browser") else { return };
    let folder = tempfile::tempdir().expect("a folder");
    for (name, set) in sets().into_iter().filter(|(name, _)| !["against", "empty"].contains(name)) {
        let panels = if name == "one" || name == "several" { sample::panels() } else { Vec::new() };
        let page = html(&set, &panels);
        let path = folder.path().join(format!("{name}.html"));
        std::fs::write(&path, instrumented(&page)).expect("writes");
        let dark = name == "one";
        let document = open(&browser, &path, dark, None);
        let noted = |key: &str| noted(&document, key);
        assert_eq!(noted("faults"), "none", "{name}");
        assert_eq!(noted("requests"), "0", "{name}");
        let pictures = 3 * panels.len();
        assert_eq!(noted("pictures"), format!("{pictures} of {pictures}"), "{name}");
        assert_eq!(noted("tables"), page.matches("<table ").count().to_string(), "{name}");
        assert_eq!(noted("tables"), noted("captions"), "{name}");
        assert_eq!(noted("drawn"), "true", "{name}");
        assert_eq!(noted("wide"), "true", "{name}: the page scrolls sideways");
        let [light_colour, dark_colour] = ["rgb(255, 255, 255)", "rgb(16, 20, 24)"];
        let [first, second] =
            if dark { [dark_colour, light_colour] } else { [light_colour, dark_colour] };
        assert_eq!([noted("first"), noted("second"), noted("third")], [first, second, first]);
        if name == "one" {
            assert_eq!(noted("sorted"), "true true 56");
            let tables = [
                "Both averages of each score",
                "Distribution of the errors",
                "By slope",
                "Registration of images and ground truth",
                "Reasons",
                "Images, worst first",
            ];
            for table in tables {
                assert!(document.contains(&format!("<caption>{table}")), "{table}");
            }
        }
    }
}

#[test]
fn the_browser_notices_what_a_report_must_not_do() {
    let Some(browser) = browser("the_browser_notices_what_a_report_must_not_do") else { return };
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("report.html");
    let bad =
        "<img src=\"https://example.invalid/x.png\"><script>missing_function()</script></main>";
    let page = html(&sample::nothing(), &[]).replacen("</main>", bad, 1);
    std::fs::write(&path, instrumented(&page)).expect("writes");
    let document = open(&browser, &path, false, None);
    let faults = noted(&document, "faults");
    assert!(faults.contains("blocked https://example.invalid"), "{faults}");
    assert!(faults.contains("missing_function"), "{faults}");
    assert_eq!(noted(&document, "pictures"), "0 of 1");
}

#[test]
fn the_report_is_drawn_in_light_and_in_dark() {
    let Some(browser) = browser("the_report_is_drawn_in_light_and_in_dark") else { return };
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("report.html");
    let set = sample::set(&["out"], &[Protocol::Paper], 60);
    std::fs::write(&path, html(&set, &sample::panels())).expect("writes");
    let brightness = [false, true].map(|dark| {
        let picture = folder.path().join(format!("{dark}.png"));
        open(&browser, &path, dark, Some(&picture));
        let picture = image::open(&picture).expect("a screenshot").into_luma8();
        assert_eq!(picture.dimensions(), (1200, 1600));
        // Something is drawn on the ground: text, lines, charts.
        let ground = picture.get_pixel(2, 2).0[0];
        let drawn = picture.pixels().filter(|p| p.0[0].abs_diff(ground) > 60).count();
        assert!(drawn > 20_000, "{drawn} pixels are drawn");
        picture.pixels().map(|p| f64::from(p.0[0])).sum::<f64>() / (1200.0 * 1600.0)
    });
    assert!(brightness[0] > 220.0 && brightness[1] < 60.0, "{brightness:?}");
}
