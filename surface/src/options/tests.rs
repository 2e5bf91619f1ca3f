use super::*;
use crate::particles::LONE_RADIUS;
use crate::spacing::IRREGULAR;

#[test]
fn settings_resolve_again_from_their_own_options() {
    let preset = |&preset| MethodOptions { preset: Some(preset), ..MethodOptions::default() };
    let chosen = Preset::ALL.iter().filter(|preset| **preset != Preset::Auto);
    let presets: Vec<MethodOptions> = chosen.map(preset).collect();
    let others = [
        MethodOptions {
            anisotropy: Some(AnisotropyKind::Velocity),
            max_stretch: Some(2.0),
            ..MethodOptions::default()
        },
        MethodOptions { position_smoothing: Some(0.9), ..MethodOptions::default() },
        MethodOptions {
            attributes: Some(AttributeSelection::All),
            velocity_scale: Some(24.0),
            ..MethodOptions::default()
        },
        MethodOptions {
            anisotropy: Some(AnisotropyKind::Neighbors),
            neighbor_radius: Some(2.0.into()),
            ..MethodOptions::default()
        },
        MethodOptions {
            radius_attribute: Some("pscale".into()),
            quads: Some(true),
            ..MethodOptions::default()
        },
        MethodOptions {
            integrator: Some(Integrator::Implicit),
            decimate: Some(0.1),
            ..MethodOptions::default()
        },
    ];
    let all: Vec<Settings> = presets
        .iter()
        .chain(&others)
        .map(|choices| Settings::resolve(choices, Some(SequenceSpacing::from(1.0))).expect("sound"))
        .collect();
    for (index, settings) in all.iter().enumerate() {
        assert_eq!(Settings::resolve(&settings.to_options(), None).as_ref(), Ok(settings));
        assert!(!all[..index].contains(settings), "{settings:?} twice");
    }
}

#[test]
fn radius_ratio_keeps_the_typed_value() {
    // For some of these voxel sizes, the rounded value of 3 r_min / r_min is not 3.
    for voxel_size in [0.1, 0.03, 0.022_176_949_191_354_715, 1.0 / 3.0] {
        let choices = MethodOptions { radius_ratio: Some(3.0), ..MethodOptions::default() };
        let settings = Settings::paper(voxel_size, &choices).expect("sound");
        assert_eq!(settings.to_options().radius_ratio, Some(3.0));
        assert_eq!(Settings::resolve(&settings.to_options(), None), Ok(settings));
    }
}

#[test]
fn presets_smooth_for_the_same_time_with_any_integrator() {
    for integrator in [Integrator::Fast, Integrator::Implicit, Integrator::Explicit, Integrator::Adaptive] {
        let resolved = |preset, steps| {
            let choices =
                MethodOptions { preset, steps, integrator: Some(integrator), ..MethodOptions::default() };
            Settings::paper(1.0, &choices).expect("sound")
        };
        for preset in Preset::ALL {
            assert_eq!(resolved(Some(*preset), Some(7)).smoothing.steps, 7);
        }
        let [fluid, preview] = [Preset::Fluid, Preset::Preview].map(|preset| resolved(Some(preset), None));
        let time = |settings: &Settings| f64::from(settings.smoothing.steps) * settings.smoothing.step_size;
        // 0.006 d⁴, with d = 2 h; steps of a fixed size are rounded to a whole number.
        assert!((time(&fluid) - 0.096).abs() < 0.005);
        assert_eq!(preview.voxel_size, 1.0);
    }
}

/// The lengths and times of settings, in particle spacings and their powers. r_min is one voxel.
fn in_spacings(settings: &Settings) -> [f64; 7] {
    let h = settings.voxel_size / settings.spacing;
    let lengths = [settings.radius_min, settings.radius_init, settings.radius_max, settings.neighbor_radius];
    let [min, init, max, radius] = lengths.map(|length| length / settings.spacing);
    let time = f64::from(settings.smoothing.steps) * settings.smoothing.step_size * h.powi(4);
    let laplacian_time = f64::from(settings.smoothing.laplacian_steps) * h * h;
    [min / h, init, max, radius, time, laplacian_time, settings.fill_cavities * h.powi(3)]
}

#[test]
fn help_states_the_least_blend() {
    let help = MethodOptions::info("blend").expect("an option").help.concat();
    let least = crate::words::significant((LEAST_REACH_VOXELS * 100.0).round() / 100.0).to_string();
    assert_eq!(help.matches(&format!("{least}h")).count(), 2, "{help}");
}

#[test]
fn finer_grid_keeps_lengths_and_times() {
    for spacing in [1.0, 0.3, 7e5] {
        let resolved = |voxels: f64| {
            let voxel_size = Some((spacing / voxels).into());
            let preset = Some(Preset::Fluid);
            let choices =
                MethodOptions { preset, spacing: Some(spacing), voxel_size, ..MethodOptions::default() };
            in_spacings(&Settings::resolve(&choices, None).expect("sound"))
        };
        let usual = resolved(3.0);
        // The number of Laplacian steps is rounded.
        for (voxels, slack) in [(2.7, 0.05), (4.0, 0.05), (6.0, 0.05)] {
            for (finer, usual) in resolved(voxels).into_iter().zip(usual) {
                assert!((finer / usual - 1.0).abs() <= slack, "{voxels}: {finer} and not {usual}");
            }
        }
        // On coarse voxels the reach is raised, so that a lone particle does not fall between voxels.
        for (voxels, reach) in [(2.0, 1.7), (1.0, 1.1 / f64::from(LONE_RADIUS))] {
            let coarse = resolved(voxels);
            assert!((coarse[2] - reach).abs() < 1e-9, "{coarse:?}");
            assert!((coarse[3] - usual[3]).abs() < 1e-9);
        }
    }
}

#[test]
fn given_spacing_overrides_the_measured_one() {
    const FLUID: Option<Preset> = Some(Preset::Fluid);
    let choices = |spacing, voxel_size: Option<f64>, preset| MethodOptions {
        spacing,
        voxel_size: voxel_size.map(Length::from),
        preset,
        ..MethodOptions::default()
    };
    let resolved = |choices: &MethodOptions, measured: Option<f64>| {
        let settings = Settings::resolve(choices, measured.map(SequenceSpacing::from))?;
        Ok::<_, SettingsError>((settings.spacing, settings.voxel_size))
    };
    assert_eq!(resolved(&choices(Some(0.2), None, FLUID), Some(0.5)), Ok((0.2, 0.064)));
    assert_eq!(resolved(&choices(None, None, FLUID), Some(0.5)), Ok((0.5, 0.16)));
    assert_eq!(resolved(&choices(None, Some(0.3), FLUID), Some(0.5)), Ok((0.5, 0.3)));
    assert_eq!(resolved(&choices(None, Some(0.32), FLUID), None), Ok((1.0, 0.32)));
    let paper = choices(None, Some(0.3), Some(Preset::Paper));
    assert_eq!(resolved(&paper, None), Ok((0.6, 0.3)));
    assert!(!paper.needs_measuring());
    for unknown in [choices(None, None, FLUID), choices(None, None, Some(Preset::Paper))] {
        assert!(unknown.needs_measuring());
        let error = resolved(&unknown, None).expect_err("unknown");
        assert!(error.to_string().contains("--spacing"), "{error}");
    }
    // The voxel size follows small particle radii, but only down to a limit, because the radii might be in
    // another unit.
    let of_radius = |radius| {
        let measured = SequenceSpacing { radius_median: Some(radius), ..SequenceSpacing::from(1.0) };
        Settings::resolve(&choices(None, None, FLUID), Some(measured)).expect("sound").voxel_size
    };
    assert_eq!([of_radius(0.5), of_radius(0.25), of_radius(2.0), of_radius(1e-6)], [0.32, 0.16, 0.32, 0.125]);
}

#[test]
fn offset_out_of_range_is_rejected_with_the_range() {
    let resolved = |offset: f64| {
        let choices = MethodOptions {
            radius_min: Some(0.5.into()),
            offset: Some(offset.into()),
            ..MethodOptions::default()
        };
        Settings::paper(0.25, &choices)
    };
    for offset in [-0.5, -0.1, 0.0, 0.5] {
        let settings = resolved(offset).expect("in range");
        assert_eq!(settings.offset, offset);
        // Files do not record an offset of 0, so that they have the same bytes as before the option existed.
        assert_eq!(settings.pairs(|_| true).iter().any(|(name, _)| *name == "offset"), offset != 0.0);
        assert_eq!(Settings::resolve(&settings.to_options(), None), Ok(settings));
    }
    for offset in [-0.51, 0.51, f64::INFINITY] {
        let error = resolved(offset).expect_err("out of range").to_string();
        let expected = format!("the offset is {offset}; it must be from -r_min = -0.5 to 2 h = 0.5");
        assert_eq!(error, expected);
    }
}

#[test]
fn lengths_out_of_range_are_named_as_typed() {
    // d = 0.1 and h = 0.032.
    for (name, text, expected) in [
        ("offset", "5h", "the offset 5h is 0.16; it must be from -(radius of a lone particle) = -0.060"),
        ("offset", "-2d", "the offset -2d is -0.2; it must be from -(radius of a lone particle) = -0.060"),
        ("offset", "0.2", "the offset is 0.2; it must be from -(radius of a lone particle) = -0.060"),
        ("voxel_size", "-1d", "the voxel size -1d is -0.1; it must be a positive number"),
        ("blend", "-1d", "the blend -1d is -0.1; it must be a positive number"),
        ("blend", "2.5h", "the blend 2.5h is 0.08; it must be from 0.098"),
        (
            "blend",
            "65h",
            "the blend 65h is 2.08; it must be from 0.0988156 to 2.048, which is 3.08799 to 64 voxels",
        ),
        ("neighbor_radius", "90d", "the neighbour radius 90d is 281.25 h; it must be at most 200 h"),
    ] {
        let error = Settings::resolve(&options(&[(name, text)]), Some(0.1.into())).expect_err(text);
        assert!(error.to_string().starts_with(expected), "{error}");
    }
}

#[test]
fn many_steps_cause_a_warning() {
    let warning_of = |integrator, steps, step_size| {
        let choices =
            MethodOptions { integrator: Some(integrator), steps, step_size, ..MethodOptions::default() };
        Settings::paper(1.0, &choices)
            .expect("sound")
            .warnings()
            .into_iter()
            .find(|warning| warning.contains(" steps for each"))
    };
    let adaptive = warning_of(Integrator::Adaptive, None, Some(20.0)).expect("a warning");
    assert!(adaptive.starts_with("at least 720000 steps"), "{adaptive}");
    let explicit = warning_of(Integrator::Explicit, Some(5000), None).expect("a warning");
    assert!(explicit.starts_with("5000 steps"), "{explicit}");
    for integrator in [Integrator::Fast, Integrator::Explicit, Integrator::Adaptive] {
        assert_eq!(warning_of(integrator, None, None), None);
        assert_eq!(warning_of(integrator, Some(2000), None), None);
    }
}

#[test]
fn voxels_larger_than_the_spacing_cause_a_warning() {
    let warnings = |preset, voxel_size: &str| {
        let choices = MethodOptions {
            preset: Some(preset),
            spacing: Some(0.1),
            voxel_size: Some(voxel_size.parse().expect("a length")),
            ..MethodOptions::default()
        };
        Settings::resolve(&choices, None).expect("sound").warnings().join("; ")
    };
    assert!(warnings(Preset::Fluid, "0.2").contains("choose at most 0.1, or 0.032, the default"));
    assert_eq!([warnings(Preset::Fluid, "1d"), warnings(Preset::Paper, "0.2")], ["", ""]);
}

#[test]
fn options_are_checked_before_the_voxel_size_is_known() {
    let choices = |radius_min: Option<f64>, radius_ratio| MethodOptions {
        preset: Some(Preset::Paper),
        radius_min: radius_min.map(Length::from),
        radius_ratio,
        ..MethodOptions::default()
    };
    let blend = |blend: f64| MethodOptions { blend: Some(blend.into()), ..MethodOptions::default() };
    for sound in [
        choices(None, None),
        choices(Some(1e-9), None),
        choices(Some(1e9), Some(20.0)),
        choices(None, Some(4.0)),
        choices(Some(0.1), Some(4.0)),
        blend(1e-9),
        blend(1e9),
        MethodOptions { offset: Some(7.0.into()), ..choices(Some(0.1), None) },
        MethodOptions { offset: Some((-0.1).into()), ..choices(Some(0.1), None) },
        MethodOptions { offset: Some((-7.0).into()), ..MethodOptions::default() },
        // Some particle spacing makes this valid.
        MethodOptions { neighbor_radius: Some(201.0.into()), ..MethodOptions::default() },
    ] {
        assert_eq!(Settings::check(&sound), Ok(()), "{sound:?}");
    }
    for (invalid, word) in [
        (choices(None, Some(0.5)), "ratio"),
        (choices(None, Some(-1.0)), "ratio"),
        (choices(None, Some(f64::NAN)), "ratio"),
        (choices(Some(-1.0), None), "r_min"),
        (choices(Some(f64::INFINITY), None), "r_min"),
        (blend(0.0), "blend"),
        (blend(f64::NAN), "blend"),
        (choices(None, Some(1000.0)), "voxels"),
        (
            MethodOptions { steps: Some(u32::MAX), ..MethodOptions::default() },
            "steps is 4294967295; it must be from 0 to 1000000",
        ),
        (MethodOptions { max_stretch: Some(0.5), ..MethodOptions::default() }, "max_stretch is 0.5"),
        (
            MethodOptions { position_smoothing: Some(1.1), ..MethodOptions::default() },
            "position_smoothing is 1.1",
        ),
        (
            MethodOptions {
                voxel_size: Some(1.0.into()),
                position_smoothing: Some(0.5),
                neighbor_radius: Some(201.0.into()),
                ..MethodOptions::default()
            },
            "neighbour radius",
        ),
        (
            MethodOptions { neighbor_radius: Some((-1.0).into()), ..MethodOptions::default() },
            "neighbour radius",
        ),
        (
            MethodOptions { void_threshold: Some(-1.0), ..MethodOptions::default() },
            "void_threshold is -1; it must be from 0 to 4",
        ),
        (MethodOptions { offset: Some(f64::NAN.into()), ..MethodOptions::default() }, "offset is NaN"),
        (
            MethodOptions { offset: Some((-0.11).into()), ..choices(Some(0.1), None) },
            "at least -r_min = -0.1",
        ),
        (MethodOptions { quads: Some(true), decimate: Some(0.1), ..MethodOptions::default() }, "quads"),
        (
            MethodOptions {
                clip: Some(ClipBox { min: [0.0; 3], max: [1.0, 0.0, 1.0] }),
                ..MethodOptions::default()
            },
            "box",
        ),
    ] {
        let error = Settings::check(&invalid).expect_err("senseless");
        assert!(error.to_string().contains(word), "{invalid:?}: {error}");
    }
}

/// Beside the lengths, the spacing decides which particles are in company.
#[test]
fn spacing_is_recorded_where_neighbors_matter() {
    let lengths = [
        ("voxel_size", "0.3"),
        ("neighbor_radius", "2.6"),
        ("laplacian_steps", "20"),
        ("step_size", "1"),
        ("fill_cavities", "0"),
    ];
    let pairs = |more: &[(&str, &str)], spacing: f64| {
        let options = options(&[&lengths[..], more].concat());
        Settings::resolve(&options, Some(SequenceSpacing::from(spacing))).expect("sound").pairs(|_| true)
    };
    let by_kernels = |spacing| pairs(&[("blend", "1.7")], spacing);
    assert_ne!(by_kernels(1.0), by_kernels(1.1));
    let of_spheres = |spacing| pairs(&[("preset", "paper")], spacing);
    assert_eq!(of_spheres(1.0), of_spheres(1.1));
}

/// Parses options from text.
fn options(pairs: &[(&str, &str)]) -> MethodOptions {
    MethodOptions::from_pairs(pairs.iter().copied()).expect("options")
}

#[test]
fn lengths_in_spacings_and_voxels_convert_to_world_units() {
    let given = [
        ("spacing", "0.5"),
        ("voxel_size", "0.4d"),
        ("blend", "5h"),
        ("offset", "-0.3d"),
        ("neighbor_radius", "5h"),
    ];
    let world = [
        ("spacing", "0.5"),
        ("voxel_size", "0.2"),
        ("blend", "1"),
        ("offset", "-0.15"),
        ("neighbor_radius", "1"),
    ];
    let [given, world] = [given, world].map(|pairs| options(&pairs));
    let settings = Settings::resolve(&given, None).expect("sound");
    assert_eq!(Settings::resolve(&world, None).as_ref(), Ok(&settings));
    assert_eq!(settings.to_options().blend, Some(1.0.into()));
    assert_eq!(Settings::check(&MethodOptions { spacing: None, ..given }), Ok(()));
}

#[test]
fn lengths_in_spacings_need_the_spacing_and_those_in_voxels_do_not() {
    let paper = |name, value| options(&[("preset", "paper"), ("voxel_size", "0.1"), (name, value)]);
    assert!(paper("radius_min", "0.9d").needs_measuring());
    assert!(!paper("radius_min", "2h").needs_measuring() && !paper("radius_min", "0.2").needs_measuring());
    assert!(options(&[("preset", "paper"), ("voxel_size", "0.5d")]).needs_measuring());
    let in_voxels: Length = "2h".parse().expect("a length");
    let options_in_voxels = MethodOptions { spacing: Some(1.0), ..MethodOptions::default() };
    let options_in_voxels = MethodOptions { voxel_size: Some(in_voxels), ..options_in_voxels };
    let error = Settings::resolve(&options_in_voxels, None).expect_err("no unit");
    assert!(error.to_string().contains("2h") && error.to_string().contains("0.4d"), "{error}");
    // Lengths in different units are compared once the spacing is known.
    assert_eq!(Settings::check(&options(&[("blend", "0.1"), ("neighbor_radius", "9d")])), Ok(()));
    assert!(Settings::check(&options(&[("blend", "2d"), ("voxel_size", "1d")])).is_err());
}

#[test]
fn auto_becomes_the_preset_that_suits_the_particles() {
    let of = |preset| MethodOptions { preset: Some(preset), ..MethodOptions::default() };
    let resolved = |options: &MethodOptions, irregularity| {
        let measured = SequenceSpacing { irregularity, ..SequenceSpacing::from(0.5) };
        Settings::resolve(options, Some(measured)).expect("sound")
    };
    for (irregularity, chosen) in [
        (None, Preset::Fluid),
        (Some(0.0), Preset::Fluid),
        (Some(IRREGULAR), Preset::Fluid),
        (Some(IRREGULAR.next_up()), Preset::Noisy),
        (Some(1.0), Preset::Noisy),
    ] {
        let settings = resolved(&of(Preset::Auto), irregularity);
        assert_eq!(settings, resolved(&of(chosen), irregularity));
        assert_eq!((settings.preset, settings.to_options().preset), (chosen, Some(chosen)));
        assert_eq!(resolved(&of(Preset::Splash), irregularity).preset, Preset::Splash);
    }
    // A given spacing is used, but which preset suits must be measured; the radii then change no voxel size.
    let given = MethodOptions { spacing: Some(0.1), ..of(Preset::Auto) };
    assert!(given.needs_measuring());
    let measured = SequenceSpacing { radius_median: Some(0.01), ..SequenceSpacing::from(0.5) };
    let settings = Settings::resolve(&given, Some(measured)).expect("sound");
    assert_eq!(
        settings,
        Settings::resolve(&MethodOptions { spacing: Some(0.1), ..of(Preset::Fluid) }, None).expect("sound")
    );
    // Options are valid before the measurement if they are so with one of the presets.
    for (blend, is_valid) in [("1.8d", true), ("0.9d", false)] {
        let options = MethodOptions { blend: Some(blend.parse().expect("a length")), ..given.clone() };
        assert_eq!(Settings::check(&options).is_ok(), is_valid, "{blend}");
    }
}

#[test]
fn presets_have_other_names() {
    for (name, preset) in [
        ("sph", Preset::Fluid),
        ("flip", Preset::Noisy),
        ("mpm", Preset::Noisy),
        ("sand", Preset::Granular),
        ("auto", Preset::Auto),
    ] {
        assert_eq!(options(&[("preset", name)]).preset, Some(preset));
        let json = format!(r#"{{"preset":"{name}"}}"#);
        assert_eq!(serde_json::from_str::<MethodOptions>(&json).expect("read").preset, Some(preset));
    }
    let mut names: Vec<&str> =
        Preset::WORDS.iter().flat_map(|word| word.others.iter().copied().chain([word.name])).collect();
    let count = names.len();
    names.sort_unstable();
    names.dedup();
    assert_eq!(names.len(), count);
    assert!(Preset::WORDS[1].full_help().ends_with("; also called flip, mpm"));
}

#[test]
fn errors_propose_only_units_that_the_option_takes() {
    for (name, text, proposed) in [
        ("voxel_size", "5h", "0.4d"),
        ("voxel_size", "wide", "0.4d"),
        ("spacing", "0.6d", "such as 0.05"),
        ("radius_min", "wide", "5h"),
    ] {
        let why = MethodOptions::default().set(name, text).expect_err(text);
        assert!(why.contains(proposed), "{why}");
        assert!(name == "radius_min" || !why.contains("such as 5h"), "{why}");
    }
}

#[test]
fn options_round_trip_through_serde() {
    let given = options(&[
        ("preset", "splash"),
        ("radius_min", "0.6d"),
        ("offset", "0.1"),
        ("steps", "3"),
        ("clip", "0,0,0,1,1,1"),
    ]);
    let json = serde_json::to_string(&given).expect("written");
    let expected = r#"{"preset":"splash","radius_min":"0.6d","offset":0.1,"clip":"0,0,0,1,1,1","steps":3}"#;
    assert_eq!(json, expected);
    assert_eq!(serde_json::from_str::<MethodOptions>(&json).expect("read"), given);
    assert!(serde_json::from_str::<MethodOptions>(r#"{"radius_mine": 1}"#).is_err());
}
