use super::clock::{Judged, Subject, Way};
use super::*;
use std::cell::RefCell;

fn setting(name: &str, seconds: f64, error: f64, default: bool) -> Setting {
    Setting {
        name: name.into(),
        default,
        error,
        bound: None,
        also: Vec::new(),
        seconds: Seconds::of(vec![seconds, 0.9 * seconds, 1.1 * seconds]),
        pareto: false,
    }
}

fn switch(settings: Vec<Setting>) -> Switch {
    let mut switch = Switch {
        stage: Stage::Build,
        switch: "transform".into(),
        cause: "a <cause>".into(),
        truth: "a & truth".into(),
        error: Quantity::new("error", "m"),
        work: "an image".into(),
        settings,
        skipped: Vec::new(),
    };
    switch.mark_pareto();
    switch
}

fn report(switches: Vec<Switch>) -> Report {
    let plan = plan(&Options::default());
    Report {
        software: "sat3d".into(),
        machine: Machine::here(1),
        plan_sha256: plan.hash(),
        plan,
        switches,
        failed: Vec::new(),
        interrupted: false,
        seconds: 1.0,
    }
}

#[test]
fn the_front_holds_what_nothing_else_beats() {
    let found = switch(vec![
        setting("slow and exact", 4.0, 0.0, false),
        setting("slower and no better", 5.0, 0.0, false),
        setting("between", 2.0, 0.1, true),
        setting("fast", 1.0, 0.5, false),
        setting("fast and worse", 1.0, 0.7, false),
        setting("unknown error", 0.5, f64::NAN, false),
    ]);
    let on: Vec<bool> = found.settings.iter().map(|s| s.pareto).collect();
    assert_eq!(on, [true, false, true, true, false, true]);
    assert_eq!(found.beats_default(), None);
}

#[test]
fn a_default_is_beaten_only_beyond_the_spread() {
    let beside = |seconds| {
        switch(vec![setting("default", 1.0, 0.1, true), setting("other", seconds, 0.1, false)])
    };
    assert_eq!(beside(0.95).beats_default(), None, "within the spread");
    assert_eq!(beside(0.5).beats_default().map(|s| &*s.name), Some("other"));
}

#[test]
fn quartiles_are_those_of_the_rounds() {
    let seconds = Seconds::of(vec![5.0, 1.0, 3.0, 2.0, 4.0]);
    assert_eq!([seconds.lower_quartile, seconds.median, seconds.upper_quartile], [2.0, 3.0, 4.0]);
    assert_eq!(Seconds::of(vec![7.0]).upper_quartile, 7.0);
}

#[test]
fn ways_take_turns_and_every_round_begins_with_another() {
    let stop = Interrupt::default();
    let order = RefCell::new(Vec::new());
    let way = |name: usize| {
        let order = &order;
        Way::new(name.to_string(), name == 0, move || {
            order.borrow_mut().push(name);
            std::thread::sleep(std::time::Duration::from_millis(6));
            Ok(name)
        })
    };
    let subject =
        Subject { truth: "", error: Quantity::new("", ""), work: String::new(), units: 2.0 };
    let clock = Clock::new(3, true, &stop);
    let found = clock
        .measure(subject, (0..3).map(way).collect(), |name| Ok(Judged::new(*name as f64)))
        .expect("nothing fails");
    let order = order.into_inner();
    // Each is run twice before the rounds, once to be judged and once warm.
    assert_eq!(order[..6], [0, 0, 1, 1, 2, 2]);
    assert_eq!(order[6..], [0, 1, 2, 1, 2, 0, 2, 0, 1]);
    assert_eq!(found.settings[2].error, 2.0);
    let seconds = found.settings[0].seconds;
    assert_eq!(seconds.rounds, 3);
    assert!(seconds.median >= 3e-3, "half of the 6 ms for each of two units: {seconds:?}");
}

#[test]
fn an_interrupt_ends_a_measurement() {
    let stop = Interrupt::default();
    stop.request();
    let subject =
        Subject { truth: "", error: Quantity::new("", ""), work: String::new(), units: 1.0 };
    let ways = vec![Way::new("never", true, || Ok(()))];
    let found = Clock::new(3, true, &stop).measure(subject, ways, |()| Ok(Judged::new(0.0)));
    assert!(matches!(found, Err(TradeoffError::Interrupted)));
}

#[test]
fn the_plan_names_every_switch_once_and_says_why_one_is_left_out() {
    let options =
        Options { stages: vec![Stage::Build, Stage::Infer], quick: true, ..Options::default() };
    let plan = plan(&options);
    let mut ids: Vec<&str> = plan.steps.iter().map(|step| &*step.id).collect();
    ids.dedup();
    assert_eq!(ids.len(), studies().len());
    let precision = plan.step("infer/precision").expect("there is one");
    assert!(!precision.on && precision.reason.contains("--quick"));
    let stride = plan.step("tile/stride").expect("there is one");
    assert!(!stride.on && stride.reason.contains("--stage"));
    assert!(plan.step("build/transform").is_some_and(|step| step.on));
}

#[test]
fn nothing_to_measure_is_said() {
    for options in [
        Options { rounds: 0, ..Options::default() },
        Options { stages: Vec::new(), ..Options::default() },
        Options { threads: 0, ..Options::default() },
    ] {
        assert!(matches!(run(&options, &Interrupt::default()), Err(TradeoffError::Input(_))));
    }
}

#[test]
fn text_and_page_hold_every_setting_and_nothing_unescaped() {
    let found = report(vec![switch(vec![
        setting("zero <b>", 4e-3, 0.0, true),
        setting("some", 1e-3, 2.5e-7, false),
    ])]);
    let text = table(&found);
    assert!(text.contains("*d  zero <b>") && text.contains("2.5e-7"), "{text}");
    assert!(text.contains("the default, zero <b>, is on the front"), "{text}");
    let page = html(&found);
    assert!(page.contains("zero &lt;b&gt;") && !page.contains("zero <b>"), "{page}");
    assert!(page.contains("class=front") && page.contains("class=default"));
    let lines = String::from_utf8(csv(&found).expect("memory")).expect("text");
    assert_eq!(lines.lines().count(), 3);
    assert!(lines.contains("build,transform,some,false,true,0.00000025"), "{lines}");
}

#[test]
fn a_setting_that_refuses_is_listed_and_anything_else_ends_the_measurement() {
    let stop = Interrupt::default();
    let measure = |default: bool, error: fn() -> TradeoffError| {
        let ways = vec![
            Way::new("works", !default, || Ok(1.0)),
            Way::new("does not", default, move || Err(error())),
        ];
        let subject =
            Subject { truth: "", error: Quantity::new("", ""), work: String::new(), units: 1.0 };
        Clock::new(3, true, &stop).measure(subject, ways, |&error: &f64| Ok(Judged::new(error)))
    };
    let refusal = || TradeoffError::Tile(TileError::Input("too wide".into()));
    let found = measure(false, refusal).expect("the other one works");
    assert_eq!(found.settings.len(), 1);
    let reason = "too wide".to_owned();
    assert_eq!(found.skipped, [Skipped { name: "does not".into(), reason }]);
    assert!(measure(true, refusal).is_err(), "what the program does by default has to work");
    assert!(measure(false, || TradeoffError::Input("broken".into())).is_err());
}
