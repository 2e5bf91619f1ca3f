use super::*;

#[test]
fn settings_are_made_again_of_their_choices() {
    let presets = Preset::ALL.map(|preset| Choices { preset: Some(preset), ..Choices::default() });
    let others = [
        Choices { anisotropy: Some(AnisotropyKind::Velocity), max_stretch: Some(2.0), ..Choices::default() },
        Choices { position_smoothing: Some(0.9), ..Choices::default() },
        Choices {
            anisotropy: Some(AnisotropyKind::Neighbors),
            neighbor_radius: Some(2.0),
            ..Choices::default()
        },
        Choices { radius_attribute: Some("pscale".into()), quads: Some(true), ..Choices::default() },
        Choices { integrator: Some(Integrator::Implicit), decimate: Some(0.1), ..Choices::default() },
    ];
    let all: Vec<Settings> = presets
        .iter()
        .chain(&others)
        .map(|choices| Settings::resolve(choices, Some(Measured::from(1.0))).expect("sound"))
        .collect();
    for (index, settings) in all.iter().enumerate() {
        assert_eq!(Settings::resolve(&settings.to_choices(), None).as_ref(), Ok(settings));
        assert!(!all[..index].contains(settings), "{settings:?} twice");
    }
}

#[test]
fn ratios_are_printed_as_they_were_chosen() {
    // 3 r_min / r_min is not 3 for all of these.
    for voxel_size in [0.1, 0.03, 0.022_176_949_191_354_715, 1.0 / 3.0] {
        let choices = Choices { preset: Some(Preset::Smooth), ..Choices::default() };
        let settings = Settings::paper(voxel_size, &choices).expect("sound");
        assert_eq!(settings.to_choices().radius_ratio, Some(3.0));
        assert_eq!(Settings::resolve(&settings.to_choices(), None), Ok(settings));
    }
}

#[test]
fn presets_take_as_much_more_or_less_with_any_integrator() {
    for integrator in [Integrator::Fast, Integrator::Implicit, Integrator::Explicit, Integrator::Adaptive] {
        let resolved = |preset, steps| {
            let choices = Choices { preset, steps, integrator: Some(integrator), ..Choices::default() };
            Settings::paper(1.0, &choices).expect("sound")
        };
        let own = resolved(None, None);
        for (preset, fifths) in [(Preset::Smooth, 10), (Preset::Faithful, 5), (Preset::Water, 5)] {
            let settings = resolved(Some(preset), None);
            assert_eq!((5 * settings.steps, settings.step_size), (fifths * own.steps, own.step_size));
            assert_eq!(resolved(Some(preset), Some(7)).steps, 7);
        }
        let [fluid, preview] = [Preset::Fluid, Preset::Preview].map(|preset| resolved(Some(preset), None));
        let time = |settings: &Settings| f64::from(settings.steps) * settings.step_size;
        assert_eq!(time(&fluid), 8.0);
        assert_eq!(preview.voxel_size, 1.0);
    }
}

/// The lengths and times of settings, in particle spacings and their powers.
fn in_spacings(settings: &Settings) -> [f64; 7] {
    let h = settings.voxel_size / settings.spacing;
    let lengths = [settings.radius_min, settings.radius_init, settings.radius_max, settings.neighbor_radius];
    let [min, init, max, radius] = lengths.map(|length| length / settings.spacing);
    let time = f64::from(settings.steps) * settings.step_size * h.powi(4);
    let laplacian_time = f64::from(settings.laplacian_steps) * h * h;
    [min, init, max, radius, time, laplacian_time, settings.fill_cavities * h.powi(3)]
}

#[test]
fn a_finer_grid_has_the_same_surface_to_show() {
    for spacing in [1.0, 0.3, 7e5] {
        let resolved = |voxels: f64| {
            let voxel_size = Some(spacing / voxels);
            let preset = Some(Preset::Fluid);
            let choices = Choices { preset, spacing: Some(spacing), voxel_size, ..Choices::default() };
            in_spacings(&Settings::resolve(&choices, None).expect("sound"))
        };
        let usual = resolved(2.5);
        // Laplacian steps are whole.
        for (voxels, slack) in [(2.0, 0.1), (4.0, 0.05), (6.0, 0.05)] {
            for (finer, usual) in resolved(voxels).into_iter().zip(usual) {
                assert!((finer / usual - 1.0).abs() <= slack, "{voxels}: {finer} and not {usual}");
            }
        }
        let anisotropy = |voxels: f64, kind| {
            let voxel_size = Some(spacing / voxels);
            let choices =
                Choices { voxel_size, spacing: Some(spacing), anisotropy: kind, ..Choices::default() };
            Settings::resolve(&choices, None).expect("sound").anisotropy
        };
        let thin = |voxels: f64| match anisotropy(voxels, None) {
            Anisotropy::Neighbors { thin_radius, .. } => thin_radius / spacing,
            other => panic!("{other:?}"),
        };
        // Particles are as flat as the grid can hold.
        assert!((thin(2.5) - 0.36).abs() < 1e-9 && (thin(6.0) - 0.36).abs() < 1e-9);
        assert!((thin(2.0) - 0.45).abs() < 1e-9 && (thin(2.49) - 0.9 / 2.49).abs() < 1e-9);
        // Where r_min is √3 h, particles are balls unless somebody asks for others.
        assert_eq!(anisotropy(1.0, None), Anisotropy::None);
        assert!(matches!(anisotropy(1.0, Some(AnisotropyKind::Neighbors)), Anisotropy::Neighbors { .. }));
        // On coarse voxels r_min is raised, and the other radii with it.
        let coarse = resolved(1.0);
        assert!((coarse[0] - 3f64.sqrt()).abs() < 1e-9);
        assert!((coarse[1] / coarse[0] - usual[1] / usual[0]).abs() < 1e-9);
        assert!((coarse[3] - usual[3]).abs() < 1e-9);
    }
}

#[test]
fn the_spacing_is_the_one_that_was_stated_or_the_measured_one() {
    const FLUID: Option<Preset> = Some(Preset::Fluid);
    let choices = |spacing, voxel_size, preset| Choices { spacing, voxel_size, preset, ..Choices::default() };
    let resolved = |choices: &Choices, measured: Option<f64>| {
        let settings = Settings::resolve(choices, measured.map(Measured::from))?;
        Ok::<_, SettingsError>((settings.spacing, settings.voxel_size))
    };
    assert_eq!(resolved(&choices(Some(0.2), None, FLUID), Some(0.5)), Ok((0.2, 0.08)));
    assert_eq!(resolved(&choices(None, None, FLUID), Some(0.5)), Ok((0.5, 0.2)));
    assert_eq!(resolved(&choices(None, Some(0.3), FLUID), Some(0.5)), Ok((0.5, 0.3)));
    assert_eq!(resolved(&choices(None, Some(0.3), FLUID), None), Ok((0.75, 0.3)));
    let paper = choices(None, Some(0.3), Some(Preset::Paper));
    assert_eq!(resolved(&paper, None), Ok((0.6, 0.3)));
    assert!(!paper.needs_spacing());
    for unknown in [choices(None, None, FLUID), choices(None, None, Some(Preset::Paper))] {
        assert!(unknown.needs_spacing());
        let error = resolved(&unknown, None).expect_err("unknown");
        assert!(error.what.contains("--spacing"), "{error}");
    }
    // Voxels become small enough for particles of small radii, but not as small as these ask for in another unit.
    let of_radius = |radius| {
        let measured = Measured { spacing: 1.0, radius_median: Some(radius) };
        Settings::resolve(&choices(None, None, FLUID), Some(measured)).expect("sound").voxel_size
    };
    assert_eq!([of_radius(0.3 * 3f64.sqrt()), of_radius(2.0), of_radius(1e-6)], [0.3, 0.4, 0.125]);
}

#[test]
fn offset_beyond_its_range_is_refused_with_the_range() {
    let resolved = |offset: f64| {
        let choices = Choices { radius_min: Some(0.5), offset: Some(offset), ..Choices::default() };
        Settings::paper(0.25, &choices)
    };
    for offset in [-0.5, -0.1, 0.0, 0.5] {
        let settings = resolved(offset).expect("in range");
        assert_eq!(settings.offset, offset);
        // Without an offset files say what they said before there was one.
        assert_eq!(settings.pairs(true).iter().any(|(name, _)| *name == "offset"), offset != 0.0);
        assert_eq!(Settings::resolve(&settings.to_choices(), None), Ok(settings));
    }
    for offset in [-0.51, 0.51, f64::INFINITY] {
        let error = resolved(offset).expect_err("out of range").to_string();
        let expected = format!("the offset is {offset}; it must be from -r_min = -0.5 to 2 h = 0.5");
        assert_eq!(error, expected);
    }
}

#[test]
fn many_steps_are_told_before_they_are_taken() {
    let told = |integrator, steps, step_size| {
        let choices = Choices { integrator: Some(integrator), steps, step_size, ..Choices::default() };
        Settings::paper(1.0, &choices)
            .expect("sound")
            .warnings()
            .into_iter()
            .find(|warning| warning.contains(" steps for each"))
    };
    let adaptive = told(Integrator::Adaptive, None, Some(20.0)).expect("so many");
    assert!(adaptive.starts_with("at least 720000 steps"), "{adaptive}");
    let explicit = told(Integrator::Explicit, Some(5000), None).expect("so many");
    assert!(explicit.starts_with("5000 steps"), "{explicit}");
    for integrator in [Integrator::Fast, Integrator::Explicit, Integrator::Adaptive] {
        assert_eq!(told(integrator, None, None), None);
        assert_eq!(told(integrator, Some(2000), None), None);
    }
}

#[test]
fn choices_are_checked_before_a_voxel_size_is_known() {
    let choices = |radius_min, radius_ratio, radius_init| Choices {
        radius_min,
        radius_ratio,
        radius_init,
        ..Choices::default()
    };
    for sound in [
        choices(None, None, None),
        choices(Some(1e-9), None, None),
        choices(Some(1e9), Some(20.0), None),
        choices(None, None, Some(1e-9)),
        choices(None, Some(1.0), Some(1e9)),
        choices(None, Some(4.0), Some(0.3)),
        choices(Some(0.1), Some(4.0), Some(0.3)),
        Choices { offset: Some(7.0), ..choices(Some(0.1), None, None) },
        Choices { offset: Some(-0.1), ..choices(Some(0.1), None, None) },
        Choices { offset: Some(-7.0), ..Choices::default() },
        // Particles may be this far apart.
        Choices { neighbor_radius: Some(201.0), ..Choices::default() },
    ] {
        assert_eq!(Settings::check(&sound), Ok(()), "{sound:?}");
    }
    for (senseless, word) in [
        (choices(None, Some(0.5), None), "ratio"),
        (choices(None, Some(-1.0), Some(1.0)), "ratio"),
        (choices(None, Some(f64::NAN), Some(1.0)), "ratio"),
        (choices(Some(-1.0), None, None), "r_min"),
        (choices(Some(f64::INFINITY), None, None), "r_min"),
        (choices(None, None, Some(0.0)), "r_init"),
        (choices(Some(0.1), Some(2.0), Some(0.3)), "r_init is 0.3"),
        (choices(None, Some(1000.0), None), "voxels"),
        (Choices { steps: Some(u32::MAX), ..Choices::default() }, "steps"),
        (Choices { max_stretch: Some(0.5), ..Choices::default() }, "stretch"),
        (Choices { position_smoothing: Some(1.1), ..Choices::default() }, "positions"),
        (
            Choices {
                voxel_size: Some(1.0),
                position_smoothing: Some(0.5),
                neighbor_radius: Some(201.0),
                ..Choices::default()
            },
            "neighbours",
        ),
        (Choices { neighbor_radius: Some(-1.0), ..Choices::default() }, "neighbours"),
        (Choices { void_threshold: Some(-1.0), ..Choices::default() }, "void"),
        (Choices { offset: Some(f64::NAN), ..Choices::default() }, "offset is NaN"),
        (Choices { offset: Some(-0.11), ..choices(Some(0.1), None, None) }, "from -r_min = -0.1 on"),
        (Choices { quads: Some(true), decimate: Some(0.1), ..Choices::default() }, "quads"),
        (
            Choices { clip: Some(ClipBox { min: [0.0; 3], max: [1.0, 0.0, 1.0] }), ..Choices::default() },
            "box",
        ),
    ] {
        let error = Settings::check(&senseless).expect_err("senseless");
        assert!(error.what.contains(word), "{senseless:?}: {error}");
    }
}
