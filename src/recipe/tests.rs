//! Recipes against a small command line of our own, so that no real subcommand's flags matter.

use super::*;
use clap::{Arg, ArgAction, Command, value_parser};
use proptest::prelude::*;

fn root() -> Command {
    let path = || value_parser!(PathBuf);
    Command::new("sat3d")
        .arg(Arg::new("verbose").long("verbose").action(ArgAction::Count).global(true))
        .subcommand(
            Command::new("simulate")
                .arg(Arg::new("scene_file").required(true).value_parser(path()))
                .arg(Arg::new("out").long("out").required(true).value_parser(path()))
                .arg(Arg::new("shift").long("shift").allow_hyphen_values(true)),
        )
        .subcommand(
            Command::new("bench").subcommand(
                Command::new("build")
                    .arg(Arg::new("lidar").long("lidar").num_args(1..).value_parser(path()))
                    .arg(
                        Arg::new("vigor")
                            .long("vigor")
                            .action(ArgAction::Append)
                            .value_parser(path()),
                    )
                    .arg(Arg::new("max_nan").long("max-nan").value_parser(value_parser!(f64)))
                    .arg(
                        Arg::new("bands")
                            .long("bands")
                            .value_delimiter(',')
                            .value_parser(value_parser!(u8)),
                    )
                    .arg(Arg::new("verify").long("verify").num_args(0..=1).require_equals(true))
                    .arg(Arg::new("geotiff").long("geotiff").action(ArgAction::SetTrue))
                    .arg(Arg::new("explain").long("explain").action(ArgAction::SetTrue)),
            ),
        )
        .subcommand(
            Command::new("say")
                .arg(Arg::new("words").num_args(1..))
                .arg(Arg::new("loud").long("loud").action(ArgAction::SetTrue)),
        )
        .subcommand(Command::new("run"))
}

fn resolve_with(text: &str, settings: &[&str]) -> Result<Chain, Error> {
    let settings: Vec<String> = settings.iter().map(ToString::to_string).collect();
    Recipe::parse(Path::new("r.toml"), Path::new("/home/me/pipelines"), text)?.resolve(
        &settings,
        Path::new("/home/me"),
        &root(),
    )
}

fn resolve(text: &str) -> Result<Chain, Error> {
    resolve_with(text, &[])
}

/// The command line of a recipe of one step.
fn line(parameters: &str) -> String {
    let text = format!("[[step]]\ncommand = \"bench build\"\n{parameters}");
    resolve(&text).expect("resolves").steps[0].command_line()
}

/// Message and help of a recipe that is refused.
fn refusal(text: &str) -> String {
    let error = resolve(text).expect_err("is refused");
    format!("{error} | {}", error.help().unwrap_or_default())
}

#[test]
fn a_chain_is_resolved_step_by_step() {
    let chain = resolve_with(
        r#"
        description = "Small"
        closing = "See ${out}/dsm."
        [paths]
        out = "../demo"
        [variables]
        nan = 5
        [[step]]
        command = "simulate"
        out = "${out}/city"
        scene-file = "city.toml"
        [[step]]
        command = "bench build"
        lidar = ["${out}/a b", "/data"]
        max-nan = "${nan}"
        geotiff = true
        "#,
        &[],
    )
    .expect("resolves");
    let lines: Vec<String> = chain.steps.iter().map(Step::command_line).collect();
    assert_eq!(
        lines,
        [
            "sat3d simulate pipelines/city.toml --out demo/city",
            "sat3d bench build --lidar 'demo/a b' /data --max-nan 5 --geotiff",
        ]
    );
    assert_eq!(chain.closing.as_deref(), Some("See demo/dsm."));
    assert!(chain.steps[1].explains && !chain.steps[0].explains && !chain.steps[1].json);
    let (path, maker) =
        chain.steps[1].waits_for(&chain.steps[..1]).unwrap_or((Path::new(""), &chain.steps[1]));
    assert_eq!((path, maker.number), (Path::new(""), 2), "`demo/a b` lies outside `demo/city`");
}

#[test]
fn a_step_runs_for_each_combination() {
    let chain = resolve(
        r#"
        [paths]
        out = "/made"
        [variables]
        large = 9
        [[step]]
        command = "say"
        words = "first"
        [[step]]
        command = "bench build"
        each = { size = ["small", "${large}"], seed = [1, 2.50, true] }
        vigor = ["${out}/${size}", "s${seed}"]
        max-nan = "${seed}"
        [[step]]
        command = "say"
        words = "last"
        "#,
    )
    .expect("resolves");
    let lines: Vec<String> = chain.steps.iter().map(Step::command_line).collect();
    let build = |size: &str, seed: &str| {
        let path = format!("/made/{size} --vigor pipelines/s{seed}");
        format!("sat3d bench build --vigor {path} --max-nan {seed}")
    };
    assert_eq!(
        lines,
        [
            "sat3d say first".to_owned(),
            build("small", "1"),
            build("small", "2.50"),
            build("small", "true"),
            build("9", "1"),
            build("9", "2.50"),
            build("9", "true"),
            "sat3d say last".to_owned(),
        ]
    );
    assert!(chain.steps.iter().enumerate().all(|(at, step)| step.number == at + 1));
    // What a command refuses is still said of the step as it is written.
    let error = root().try_get_matches_from(chain.steps[3].words(&[])).expect_err("no number");
    let told = chain.steps[3].refused(&error).to_string();
    assert!(told.starts_with("r.toml:10: step 2 (bench build): invalid value 'true'"), "{told}");
}

#[test]
fn a_step_waits_for_what_an_earlier_one_makes() {
    let text = r#"
        [[step]]
        command = "simulate"
        scene-file = "city.toml"
        out = "no-such-folder"
        [[step]]
        command = "bench build"
        vigor = "no-such-folder/vigor"
        "#;
    let chain = resolve(text).expect("resolves");
    let (path, maker) = chain.steps[1].waits_for(&chain.steps[..1]).expect("waits");
    assert_eq!((path, maker.number), (Path::new("pipelines/no-such-folder/vigor"), 1));
    assert!(chain.steps[0].waits_for(&[]).is_none());
}

#[test]
fn values_take_the_form_that_their_flag_wants() {
    assert_eq!(line("geotiff = false"), "sat3d bench build");
    assert_eq!(line("vigor = ['/a', '/b']"), "sat3d bench build --vigor /a --vigor /b");
    assert_eq!(line("bands = [1, 0x02]"), "sat3d bench build --bands 1,2");
    assert_eq!(line("verify = true"), "sat3d bench build --verify");
    assert_eq!(line("verify = false"), "sat3d bench build");
    assert_eq!(line("verify = 'full'"), "sat3d bench build --verify=full");
    assert_eq!(line("max-nan = -1.5"), "sat3d bench build --max-nan=-1.5");
    assert_eq!(line("lidar = \"it's\""), "sat3d bench build --lidar 'pipelines/it'\\''s'");
    assert_eq!(line("lidar = []"), "sat3d bench build");
}

#[test]
fn a_positional_that_looks_like_a_flag_stands_behind_two_dashes() {
    let text = "[[step]]\ncommand = 'say'\nwords = ['-a', 'b']\nloud = true";
    let step = resolve(text).expect("resolves").steps.remove(0);
    assert_eq!(step.command_line(), "sat3d say --loud -- -a b");
    let matches = root().try_get_matches_from(step.words(&["--verbose"])).expect("parses");
    assert_eq!(matches.subcommand_matches("say").map(|m| m.get_count("verbose")), Some(1));
}

#[test]
fn what_the_command_refuses_is_said_with_its_place() {
    let step = resolve("[[step]]\ncommand = 'bench build'\nmax-nan = 'many'")
        .expect("the types are the command's business")
        .steps
        .remove(0);
    let error = root().try_get_matches_from(step.words(&[])).expect_err("no number");
    assert_eq!(
        step.refused(&error).to_string(),
        "r.toml:2: step 1 (bench build): invalid value 'many' for '--max-nan <max_nan>': invalid \
         float literal"
    );
    let step = resolve("[[step]]\ncommand = 'simulate'").expect("resolves").steps.remove(0);
    let error = root().try_get_matches_from(step.words(&[])).expect_err("two are missing");
    assert_eq!(
        step.refused(&error).to_string(),
        "r.toml:2: step 1 (simulate): the following required arguments were not provided: \
         --out <out> <scene_file>"
    );
}

#[test]
fn refusals_name_the_place_and_what_was_meant() {
    let cases = [
        ("", "r.toml: the recipe has no steps | add one:"),
        ("step = 1", "r.toml:1: `step` is a number, but must be written as [[step]]"),
        ("[[steps]]", "r.toml:1: unknown key `steps` | did you mean `step`?"),
        ("description = 3\n[[step]]", "r.toml:1: `description` is a number, but must be a text"),
        ("\n[[step]]\nlidar = 'x'", "r.toml:2: step 1: the step has no `command` | name"),
        (
            "[[step]]\ncommand = 'bnch build'",
            "unknown command `bnch build` | did you mean `bench build`?",
        ),
        ("[[step]]\ncommand = 'bench'", "step 1 (bench): unknown command `bench` | did you mean"),
        (
            "[[step]]\ncommand = 'run'",
            "unknown command `run` | commands: simulate, bench build, say",
        ),
        ("[[step]]\ncommand = ''", "unknown command ``"),
        (
            "[[step]]\ncommand = 'bench build'\n\nmax_nan = 5",
            "r.toml:4: step 1 (bench build): unknown key `max_nan` | did you mean `max-nan`? (keys: \
             lidar, vigor, max-nan, bands, verify, geotiff)",
        ),
        (
            "[[step]]\ncommand = 'bench build'\nexplain = true",
            "`explain` holds for the whole chain and cannot be set in one step | give it",
        ),
        ("[[step]]\ncommand = 'bench build'\nverbose = 1", "`verbose` holds for the whole chain"),
        (
            "[[step]]\ncommand = 'bench build'\ngeotiff = 'yes'",
            "`geotiff` is a text, but must be true or false: it is a switch",
        ),
        (
            "[[step]]\ncommand = 'bench build'\nmax-nan = [1, 2]",
            "`max-nan` is a list, but must be one value",
        ),
        (
            "[[step]]\ncommand = 'bench build'\nmax-nan = {a = 1}",
            "r.toml:3: step 1 (bench build): `max-nan` is a table, but must be a text, a number,",
        ),
        (
            "[[step]]\ncommand = 'bench build'\nmax-nan = 2021-01-01",
            "`max-nan` is a date, but must be a text, a number,",
        ),
        (
            "[[step]]\ncommand = 'bench build'\nvigor = [['a']]",
            "`vigor` is a list of more than plain values, but must be",
        ),
        (
            "[paths]\nlidar = 'x'\n[[step]]\ncommand = 'bench build'\nlidar = '${lidr}'",
            "r.toml:5: step 1 (bench build): `lidar` uses the variable `${lidr}`, which is not \
             defined | did you mean `lidar`?",
        ),
        ("[paths]\na = 3\n[[step]]", "r.toml:2: `a` is a number, but must be a path in quotes"),
        (
            "[[step]]\ncommand = 'say'\neach = 3",
            "r.toml:3: step 1 (say): `each` is a number, but must be a table of lists, as { seed",
        ),
        (
            "[[step]]\ncommand = 'say'\n[step.each]\nseed = 3",
            "r.toml:4: step 1 (say): `seed` is a number, but must be a list of texts,",
        ),
        ("[[step]]\ncommand = 'say'\neach = {a = []}", "`a` is an empty list, but must be a list"),
        (
            "[[step]]\ncommand = 'say'\neach = {a = [[1]]}",
            "`a` is a list of more than plain values, but must be a list",
        ),
        (
            "[variables]\na = 1\n[[step]]\ncommand = 'say'\neach = {a = [1]}",
            "r.toml:5: step 1 (say): `a` in `each` is a variable of the recipe, too | rename",
        ),
        (
            "[[step]]\ncommand = 'say'\neach = {a = [1], b = ['${a}']}",
            "`b` uses the variable `${a}`, which is not defined",
        ),
        (
            "[[step]]\ncommand = 'say'\neach = {seed = [1]}\nwords = '${sead}'",
            "`words` uses the variable `${sead}`, which is not defined | did you mean `seed`?",
        ),
        ("[paths]\na = ''\n[variables]\na = 1", "r.toml:4: `a` is defined in [paths] and in"),
        ("[[step]\ncommand", "r.toml:1: not TOML: "),
        ("[paths]\na = 'x'\na = 'y'", "r.toml:3: not TOML: duplicate key"),
    ];
    for (text, expected) in cases {
        let told = refusal(text);
        assert!(told.contains(expected), "{text:?}\n  says      {told}\n  expected  {expected}");
    }
}

#[test]
fn a_recipe_that_is_not_there_is_refused_by_name() {
    let error = Recipe::read(Path::new("/no/such/recipe.toml")).expect_err("is missing");
    assert!(error.to_string().starts_with("cannot read the recipe /no/such/recipe.toml: "));
}

proptest! {
    /// No text makes the reader panic, and what it accepts it can resolve or refuse.
    #[test]
    fn any_text_is_accepted_or_refused(
        parts in proptest::collection::vec(
            prop_oneof![
                Just("[[step]]\n"), Just("[paths]\n"), Just("[variables]\n"), Just("command = "),
                Just("'bench build'\n"), Just("lidar = "), Just("'${a}'\n"), Just("a = "),
                Just("'$${'\n"), Just("5\n"), Just("true\n"), Just("['x', 1]\n"), Just("\u{e9}"),
                Just("[1e400]\n"), Just("'${'\n"), Just("verify = "), Just("{}\n"), Just("each = "), Just("{a = ['${b}']}\n"), Just("'-x'\n"),
            ],
            0..14,
        )
    ) {
        let text: String = parts.concat();
        if let Ok(chain) = resolve(&text) {
            for step in &chain.steps {
                // Any answer is fine, as long as it is one.
                if let Err(error) = root().try_get_matches_from(step.words(&[])) {
                    prop_assert!(step.refused(&error).to_string().contains("r.toml:"));
                }
            }
        }
    }

    /// A text value arrives at its command as it was written, whatever is in it.
    #[test]
    fn texts_arrive_unchanged(text in "[^\u{0}]{1,20}") {
        prop_assume!(!text.contains("${"));
        let recipe = format!(
            "[[step]]\ncommand = 'simulate'\nscene-file = '/s'\nout = '/o'\nshift = {}",
            toml::Value::String(text.clone())
        );
        let step = resolve(&recipe).expect("resolves").steps.remove(0);
        let matches = root().try_get_matches_from(step.words(&[])).expect("parses");
        let sub = matches.subcommand_matches("simulate").expect("simulate");
        prop_assert_eq!(sub.get_one::<String>("shift"), Some(&text));
    }
}
